"""Where compiled code is kept that will be loaded again: nowhere that anybody else may write."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from estimators.pem.predictors.kernel import library_folder


@pytest.mark.parametrize("kind", ["good", "open to all", "link", "file", "no home"])
def test_the_folder_of_compiled_code_is_ones_own(tmp_path, monkeypatch, kind):
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    folder = cache / "oed-kernels"
    if kind == "open to all":
        folder.mkdir()
        folder.chmod(0o777)
    elif kind == "link":
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    elif kind == "file":
        folder.write_text("")
    elif kind == "no home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.delenv("HOME", raising=False)
    found = library_folder()
    assert found.stat().st_mode & 0o077 == 0
    if kind == "good":
        assert found == folder
    else:
        assert found != folder
        assert found.parent == Path(tempfile.gettempdir())
        assert len(found.name) > len("oed-kernels-"), "no name that somebody could have made before"
