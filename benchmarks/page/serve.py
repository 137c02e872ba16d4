"""`oed report DIR --serve`: one page on this machine only, which follows a campaign or a session that runs."""

import json
from collections.abc import Callable
from functools import lru_cache
from hashlib import blake2b
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from benchmarks.page.content import Page, read_page
from benchmarks.page.session import session_page
from benchmarks.page.skeleton import html
from oed.errors import OedError
from oed.files.limits import file_content

HOST = "127.0.0.1"
WATCHED = ("report.json", "session.json", "campaign.json", "journal.txt")
"""What decides the page of a folder, beside the finished parts of a campaign and the records of a session."""


def progress_of(folder: Path) -> tuple[int, int]:
    """Finished parts of a campaign and how many there are; (0, 0) where it does not say."""
    if not (folder / "campaign.json").is_file():
        return 0, 0
    try:
        found = json.loads(file_content(folder / "progress.json"))
        return int(found["done"]), int(found["total"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0, 0


def page_of(folder: Path) -> Page:
    """The page of whatever result a folder holds: finished, a session, or a campaign that still runs."""
    if (folder / "session.json").is_file():
        return session_page(folder)
    done, total = progress_of(folder)
    if (folder / "campaign.json").is_file() and (done < total or not (folder / "report.json").is_file()):
        return Page("comparison", "A comparison that runs", f"{done} of {total} parts are computed; the page comes when all are."
                    if total else "The comparison is not finished; the page comes when it is.",
                    todo=["Leave this page open: it follows.", "If nothing runs, the command that began it goes on where it stopped."],
                    progress=(done, total) if total else ())  # fmt: skip
    return read_page(folder)


def version_of(folder: Path) -> str:
    """Changes when there is something new to show."""
    done, total = progress_of(folder)
    found = blake2b(str(done < total).encode(), digest_size=8)
    for path in [
        *(folder / name for name in WATCHED),
        *sorted(folder.glob("output-*.csv")),
        *sorted(folder.glob("input-*.csv")),
    ]:
        if path.is_file():
            found.update(f"{path.name} {path.stat().st_mtime_ns}\n".encode())
    return found.hexdigest()


def state_of(folder: Path) -> dict[str, Any]:
    """What the page asks for every two seconds."""
    done, total = progress_of(folder)
    return {"version": version_of(folder), "done": done, "total": total}


def server(folder: Path) -> ThreadingHTTPServer:
    """A server of this folder's page on a free port of this machine; `serve_forever` runs it."""
    made = lru_cache(maxsize=1)(lambda version: html(page_of(folder), live=True))
    page: Callable[[], str] = lambda: made(version_of(folder))

    class Handler(BaseHTTPRequestHandler):
        """Answers two addresses, and only to whoever asked for this machine by its own name."""

        def do_GET(self) -> None:  # the name that http.server calls
            port = self.server.server_address[1]  # pyright: ignore[reportIndexIssue]
            # another site's name that leads here
            if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
                return self.send_error(421)
            if self.path not in ("/", "/state"):
                return self.send_error(404)
            try:
                text = page() if self.path == "/" else json.dumps(state_of(folder))
            except OedError as error:
                return self.send_error(503, explain=str(error))
            content = text.encode()
            self.send_response(200)
            self.send_header(
                "Content-Type", "text/html; charset=utf-8" if self.path == "/" else "application/json"
            )
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)
            return None

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing: standard error is the command's own."""

    return ThreadingHTTPServer((HOST, 0), Handler)
