"""SVG drawings as part of a page: rebuilt from the elements and attributes that a drawing needs, and nothing else.

A results folder may come from somebody else. Text between tags of another kind, comments, scripts, and references to
anything but the drawing itself do not reach the page.
"""

from __future__ import annotations

import re
from xml.etree import ElementTree

from oed.errors import CampaignError

__all__ = ["safe_drawing"]

SVG, LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
ELEMENTS = frozenset(
    [
        "svg",
        "g",
        "defs",
        "path",
        "rect",
        "circle",
        "ellipse",
        "line",
        "polyline",
        "polygon",
        "text",
        "tspan",
        "use",
        "clipPath",
        "style",
        "image",
        "title",
        "desc",
        "linearGradient",
        "radialGradient",
        "stop",
        "marker",
        "mask",
        "pattern",
    ]
)
IMAGE = re.compile(r"data:image/(png|jpeg);base64,[A-Za-z0-9+/=\s]*")
OUTSIDE = re.compile(r"url\((?!\s*['\"]?#)|@import|expression|javascript:|\\|<", re.IGNORECASE)
"""In an attribute or a style sheet: what fetches or runs something, or could be read as a tag."""

ElementTree.register_namespace("", SVG)
ElementTree.register_namespace("xlink", LINK)


def safe_drawing(text: str, name: str) -> str:
    """The drawing of an SVG file, rebuilt; a CampaignError where the file is no drawing."""
    start = text.find("<svg")  # what stands before, such as a document type with entities, is left out
    try:
        root = ElementTree.fromstring(text[max(start, 0) :])
        if root.tag != f"{{{SVG}}}svg":
            raise ValueError(f"its root is {root.tag}")
        _clean(root)
        return ElementTree.tostring(root, encoding="unicode")
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise CampaignError(f"{name} is not a drawing ({error}); make the report again.") from None


def _clean(element: ElementTree.Element) -> None:
    """Take off, in place, every attribute and child that is not of a drawing."""
    for key, value in list(element.attrib.items()):
        link = key in ("href", f"{{{LINK}}}href")
        foreign = key.startswith("{") and not link
        wrong = not (value.startswith("#") or IMAGE.fullmatch(value)) if link else OUTSIDE.search(value)
        if key.lower().startswith("on") or foreign or wrong:
            del element.attrib[key]
    if element.tag == f"{{{SVG}}}style" and OUTSIDE.search(element.text or ""):
        element.text = ""
    for child in list(element):
        known = isinstance(child.tag, str) and child.tag.removeprefix(f"{{{SVG}}}") in ELEMENTS
        if known and child.tag.startswith(f"{{{SVG}}}"):
            _clean(child)
        else:
            element.remove(child)
