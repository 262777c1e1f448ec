"""Fixtures of the page's tests; `--pictures FOLDER` keeps what they see."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from browsing import browser
from playwright.sync_api import Browser, Page

Picture = Callable[[Page, str], None]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--pictures", metavar="FOLDER", help="keep pictures of the page there")
    parser.addoption("--soak-seconds", metavar="N", help="how long the page is soaked")


@pytest.fixture(scope="module")  # its event loop would be in the way of other modules' own
def chrome() -> Iterator[Browser]:
    with browser() as running:
        yield running


@pytest.fixture
def picture(pytestconfig: pytest.Config) -> Picture:
    """Keep a picture of the page by this name, where pictures are asked for."""
    folder = pytestconfig.getoption("--pictures", default=None)

    def keep(page: Page, name: str) -> None:
        if folder is not None:
            page.screenshot(path=Path(folder) / f"page-{name}.png")

    return keep
