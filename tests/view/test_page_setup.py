"""Set up and run: what is clicked on the page is done by the station."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from browsing import Server, Station, opened, server, station
from playwright.sync_api import Browser, Page, expect

from vdms_rt.control.client import Controller
from vdms_rt.wire import control_pb2 as control

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

TOKEN = "letmecontrol"


@pytest.fixture(scope="module")
def resting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Station, Server]]:
    directory = tmp_path_factory.mktemp("setup")
    with (
        station(directory, moving=False) as running,
        server(directory, running.endpoint) as page_server,
    ):
        yield running, page_server


@pytest.fixture
def page(chrome: Browser, resting: tuple[Station, Server]) -> Iterator[Page]:
    with opened(chrome, resting[1].url) as window:
        expect(window.locator("#state")).to_have_text("measuring")
        window.select_option("#marker", "m1")
        window.click("#tab-setup")
        expect(window.locator("#regions g")).to_have_count(8)
        yield window


def first_region(resting: tuple[Station, Server]) -> control.Rectangle:
    with Controller(resting[0].endpoint, who="the test") as desk:
        return desk.ask("regions", marker="m1").regions[0].regions[0]


def happened(page: Page, text: str | re.Pattern[str]) -> None:
    """Wait until the station has told of it."""
    page.click("#tab-run")
    expect(page.locator("#events")).to_contain_text(text)
    page.click("#tab-setup")


def test_a_person_aims_the_camera_by_the_picture(
    page: Page, picture: Callable[[Page, str], None]
) -> None:
    expect(page.locator("#picture")).to_be_visible()
    assert page.locator("#picture").evaluate("image => image.naturalWidth") >= 640
    expect(page.locator("#advice li").first).not_to_be_empty()
    for term in ("expected", "focus", "exposure", "tilt", "scale", "room"):
        expect(page.locator("#aim dt", has_text=term).first).to_be_visible()
    before = page.locator("#picture").get_attribute("src")
    expect(page.locator("#picture")).not_to_have_attribute("src", before or "")
    picture(page, "setup")


def test_a_region_is_dragged_with_the_mouse_and_the_keyboard(
    page: Page, resting: tuple[Station, Server], picture: Callable[[Page, str], None]
) -> None:
    before = first_region(resting)
    group = page.locator("#regions g").first
    box = group.locator("rect").bounding_box()
    frame = page.locator("#regions").bounding_box()
    assert box is not None
    assert frame is not None
    px = frame["width"] / 720
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 4 * px, y, steps=3)
    page.mouse.up()
    expect(page.locator("#apply")).to_be_visible()
    group.focus()
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Shift+ArrowRight")
    picture(page, "region")
    page.click("#apply")
    expect(page.locator("#apply")).to_be_hidden()
    after = first_region(resting)
    assert (after.x_px - before.x_px, after.y_px - before.y_px) == (4, -1)
    assert (after.width_px - before.width_px, after.height_px) == (1, before.height_px)
    expect(page.locator("#state")).to_have_text("measuring")
    happened(page, "regions")


def test_a_region_that_is_left_alone_is_not_sent(page: Page) -> None:
    page.locator("#regions g").first.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#apply")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#apply")).to_be_hidden()


def test_marker_is_found_and_the_reference_taken(page: Page) -> None:
    page.click("#find")
    expect(page.locator("#toast")).to_be_visible()
    expect(page.locator("#toast")).not_to_have_class(re.compile("bad"))
    happened(page, re.compile("marker.*found", re.DOTALL))
    expect(page.locator("#state")).to_have_text("measuring")
    page.fill("#stills", "12")  # of each field
    page.click("text=Take reference")
    happened(page, "reference taken from 24 pictures")
    expect(page.locator("#state")).to_have_text("measuring")
    page.click("#zero-form button")
    expect(page.locator("#toast")).to_contain_text(re.compile("zero|count", re.IGNORECASE))


def test_an_impossible_size_is_refused_with_the_reason(page: Page) -> None:
    page.click("text=Printed size of the marker")
    page.fill("#spacing", "20")
    page.fill("#diameter", "50")
    page.click("#size-form button")
    expect(page.locator("#toast")).to_have_class("bad")
    expect(page.locator("#toast")).to_contain_text("diameter")


def test_set_up_is_saved_as_a_file(page: Page, tmp_path: Path) -> None:
    with page.expect_download() as download:
        page.click("#save-report")
    download.value.save_as(tmp_path / "report.txt")
    assert "marker m1" in (tmp_path / "report.txt").read_text()
    assert download.value.suggested_filename == "demo-set-up.txt"


def test_a_run_is_started_marked_and_stopped(
    page: Page, resting: tuple[Station, Server], picture: Callable[[Page, str], None]
) -> None:
    page.click("#tab-run")
    page.fill("#run-name", "???")
    page.click("#start")
    expect(page.locator("#toast")).to_have_class("bad")
    page.fill("#run-name", "sine 10mm")
    page.click("#start")
    expect(page.locator("#run-pill")).to_contain_text("sine-10mm")
    expect(page.locator("#stop")).to_be_visible()
    page.fill("#note", "the hammer falls")
    page.click("text=Mark now")
    expect(page.locator("#events")).to_contain_text("the hammer falls")
    row = page.locator("#recordings tr", has_text="sine-10mm").first
    expect(row).to_contain_text("MB")
    picture(page, "run")
    page.click("#stop")
    expect(page.locator("#start")).to_be_visible()
    expect(page.locator("#run-pill")).to_be_hidden()
    expect(row).to_contain_text("min")
    with Controller(resting[0].endpoint, who="the test") as desk:
        kept = desk.ask("recordings").recordings.recordings
    assert "sine-10mm" in {recording.run for recording in kept}


def test_a_wrong_token_is_refused_and_the_right_one_is_not(
    chrome: Browser,
    resting: tuple[Station, Server],
    tmp_path: Path,
    picture: Callable[[Page, str], None],
) -> None:
    with server(tmp_path, resting[0].endpoint, options=("--token", TOKEN)) as locked:
        url, carried = locked.url.split("#")
        assert carried == f"token={TOKEN}"
        with opened(chrome, url) as page:
            expect(page.locator("#state")).to_have_text("measuring")
            page.click("#tab-setup")
            expect(page.locator("#find")).to_be_disabled()
            page.click("#token-button")
            page.fill("#token", "letmein!")
            page.click("#token-ok")
            page.click("#find")
            expect(page.locator("#token-fault")).to_contain_text("not the token")
            picture(page, "token")
            expect(page.locator("#state")).to_have_text("measuring")
            page.fill("#token", TOKEN)
            page.click("#token-ok")
            page.click("#zero-form button")
            expect(page.locator("#toast")).not_to_have_class(re.compile("bad"))
        with opened(chrome, locked.url) as page:
            expect(page.locator("#state")).to_have_text("measuring")
            page.click("#tab-setup")
            expect(page.locator("#find")).to_be_enabled()
            assert "token" not in page.url
