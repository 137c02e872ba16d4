"""Sphinx settings of the documentation: `make docs` builds it into build/docs, warnings are errors."""

from __future__ import annotations

import hashlib
import importlib
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from docutils import nodes  # noqa: E402

import oed  # noqa: E402

project = "oed"
author = "The OED authors"
copyright = "the OED authors"
release = version = oed.__version__

# What is executed belongs to the packages that executed it: with other sources it is run again.
SOURCES = hashlib.sha256(
    b"".join(
        path.read_bytes()
        for name in ("oed", "estimators", "benchmarks")
        for path in sorted((HERE.parent / name).rglob("*.py"))
    )
)
EXECUTED = HERE.parent / "build" / "docs-cache" / SOURCES.hexdigest()[:12]

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "myst_nb",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = [
    "_build",
    "README.md",
    "gallery/*.ipynb",
    "gallery/*.py",
    "gallery/*.json",
]
html_theme = "furo"  # maintained, light, dark mode
html_extra_path = ["results/report.html"]  # beside the site's pages, and opened as it is
html_static_path, html_css_files, html_js_files = ["assets"], ["oed.css"], ["oed.js"]
templates_path = ["templates"]
html_show_sourcelink = False  # the theme puts it outside all landmarks
html_title = "oed"
html_math_renderer = "mathml"
html_show_sphinx = False

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_cache_path = str(EXECUTED)
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autosummary_generate = True
numpydoc_show_class_members = False
autodoc_typehints = "none"
suppress_warnings = ["mystnb.unknown_mime_type", "config.cache"]

sphinx_gallery_conf = {
    "examples_dirs": str(HERE.parent / "examples"),
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py",  # all are run: together they take under a minute
    "abort_on_example_error": True,
    "run_stale_examples": not EXECUTED.exists(),
    "ignore_pattern": r"__init__",
    "download_all_examples": False,
    "show_signature": False,
    "min_reported_time": 3600,  # a page that is made again is the same page
    "write_computation_times": False,  # a page that asks a server of others for its scripts
}

PACKAGES = (
    "oed", "oed.design", "oed.theory", "oed.signals", "oed.files",
    "estimators", "estimators.pem", "estimators.residual", "estimators.diagnosis", "estimators.sessions",
)  # fmt: skip


def write_reference(_app) -> None:
    """One page per package, one entry per exported name: the reference is what the packages export, no more, no less."""
    folder = HERE / "reference"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    pages = []
    for name in PACKAGES:
        package = importlib.import_module(name)
        exported = [each for each in getattr(package, "__all__", ()) if not each.startswith("_")]
        if not exported:
            continue
        first = (package.__doc__ or "").strip().splitlines()[0]
        rows = "\n".join(f"   {name}.{each}" for each in exported)
        text = f"{name}\n{'=' * len(name)}\n\n{first}\n\n.. autosummary::\n   :toctree: generated\n   :nosignatures:\n\n{rows}\n"
        (folder / f"{name}.rst").write_text(text, encoding="utf-8")
        pages.append(name)
    index = "Reference\n=========\n\nEvery name that a package exports.\n\n.. toctree::\n   :maxdepth: 1\n\n"
    (folder / "index.rst").write_text(index + "".join(f"   {page}\n" for page in pages), encoding="utf-8")


def _escape(_app, _what, _name, _object, _options, lines) -> None:
    """|G| in a docstring is a magnitude, not a substitution."""
    lines[:] = [
        line.replace("|", r"\|") if "``" not in line and ">>>" not in line else line for line in lines
    ]


def _inline(self, node) -> None:
    from latex2mathml.converter import convert

    self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _display(self, node) -> None:
    from latex2mathml.converter import convert

    self.body.append(f'<div class="math-display">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def setup(app) -> None:
    """Write the reference before Sphinx reads it; formulas are MathML, which needs no script and no network."""
    write_reference(
        app
    )  # before the environment looks for documents: autosummary makes stubs of those it found
    app.connect("autodoc-process-docstring", _escape, priority=900)
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
