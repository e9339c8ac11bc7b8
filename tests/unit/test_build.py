"""The build's work beyond packing. hatchling itself is only there while a package is built."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

HOOK = Path(__file__).parents[2] / "hatch_build.py"

PAGE = """\
![a picture](docs/a.svg)

See [the guide](docs/guide.md#radios), [below](#below) and [others](https://example.org/).
"""


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module, with something in the place of hatchling's base class."""
    interface = ModuleType("hatchling.metadata.plugin.interface")
    interface.MetadataHookInterface = object  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, interface.__name__, interface)
    spec = importlib.util.spec_from_file_location("hatch_build", HOOK)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_index_shows_links_that_lead_somewhere(hook: Any) -> None:
    assert hook.for_an_index(PAGE, "https://example.org/me/it") == (
        "![a picture](https://example.org/me/it/raw/HEAD/docs/a.svg)\n\n"
        "See [the guide](https://example.org/me/it/blob/HEAD/docs/guide.md#radios), [below](#below) and "
        "[others](https://example.org/).\n"
    )
    assert hook.for_an_index(PAGE, None) == (
        "\n\nSee the guide, [below](#below) and [others](https://example.org/).\n"
    )


def test_the_readme_of_this_project_keeps_its_pictures(hook: Any) -> None:
    root = HOOK.parent
    urls = tomllib.loads((root / "pyproject.toml").read_text())["project"]["urls"]
    project, metadata = hook.CustomMetadataHook(), {"urls": urls}
    project.root = str(root)
    project.update(metadata)
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]*)\)", metadata["readme"]["text"])
    assert len(pictures) == len(re.findall(r"!\[", (root / "README.md").read_text())) >= 2
    for picture in pictures:
        assert (root / picture.removeprefix(f"{urls['Source']}/raw/HEAD/")).is_file()


def test_a_machine_that_lacks_something_is_refused(hook: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    project = hook.CustomMetadataHook()
    project.root = str(HOOK.parent)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(RuntimeError, match=r"sudo apt install fuse3 gcc pkg-config libfuse3-dev$"):
        project.update({})
    monkeypatch.setenv("MAVFTPFS_ANY_MACHINE", "1")
    metadata: dict[str, Any] = {}
    project.update(metadata)
    assert metadata["readme"]["text"].startswith("# mavftpfs\n")
