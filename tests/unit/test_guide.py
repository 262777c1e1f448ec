"""The guide explains every state, status and event that the program knows, and nothing else."""

import ast
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from vdms_rt.capture.grabber import GRABBERS
from vdms_rt.model import State
from vdms_rt.status import STATUS_WORDS

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "guide.md").read_text()
CODE = re.compile(r"[a-z]+(-[a-z]+)*")


def explained(head: str) -> list[str]:
    """Return the first column of the guide's table with this head."""
    table = GUIDE.split(f"| {head} | what it means | what to do |\n", 1)[1].split("\n\n", 1)[0]
    return [re.match(r"\| `(.*?)` \|", row).group(1) for row in table.splitlines()[1:]]


def is_severity(node: ast.expr) -> bool:
    match node:
        case ast.Attribute(value=ast.Name(id="Severity")):
            return True
        case ast.Attribute(attr="severity"):
            return True
    return False


def codes(tree: ast.AST) -> Iterator[str]:
    """Yield every constant that follows a severity: of an Event, or on its way to one."""
    for node in ast.walk(tree):
        row = node.args if isinstance(node, ast.Call) else getattr(node, "elts", [])
        for before, after in pairwise(row):
            text = str(after.value) if isinstance(after, ast.Constant) else ""
            if is_severity(before) and CODE.fullmatch(text):
                yield text


def test_every_state_is_explained() -> None:
    assert sorted(explained("state")) == sorted(state.value for state in State)


def test_every_status_is_explained() -> None:
    assert sorted(explained("word")) == sorted(["ok", *STATUS_WORDS.values()])


def test_every_event_is_explained() -> None:
    sources = (ROOT / "src").rglob("*.py")
    found = {code for path in sources for code in codes(ast.parse(path.read_text()))}
    assert {"state", "frames-missed", "record-trouble", "command-refused"} <= found
    assert sorted(explained("code")) == sorted(found)


def test_udev_knows_the_same_grabbers() -> None:
    rules = (ROOT / "systemd" / "70-vdms-rt.rules").read_text()
    known = re.findall(r'idVendor}=="(\w+)", ATTRS{idProduct}=="([\w|]+)"', rules)
    assert sorted(f"{v}:{p}" for v, products in known for p in products.split("|")) == sorted(
        GRABBERS
    )
