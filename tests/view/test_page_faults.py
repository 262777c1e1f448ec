"""The page while what it depends on comes and goes."""

import json
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from browsing import opened, server, station
from loopback import free_endpoint
from playwright.sync_api import Browser, Page, expect

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def test_without_a_station_it_says_what_to_do(
    chrome: Browser, tmp_path: Path, picture: Callable[[Page, str], None]
) -> None:
    nobody = free_endpoint()
    with server(tmp_path, nobody) as running, opened(chrome, running.url) as page:
        expect(page.locator("#nobody")).to_contain_text(nobody)
        expect(page.locator("#nobody")).to_contain_text("vdms-rt run")
        expect(page.locator("#state")).to_have_text("no station")
        picture(page, "nobody")


def test_it_recovers_from_a_station_and_a_server_that_restart(
    chrome: Browser, tmp_path: Path, picture: Callable[[Page, str], None]
) -> None:
    with (
        station(tmp_path, moving=True) as demo,
        server(tmp_path, demo.endpoint) as running,
        opened(chrome, running.url) as page,
    ):
        peak = page.locator("#peaks li").first
        expect(peak).to_contain_text("Hz")
        demo.stop()
        expect(page.locator("#state")).to_have_text("gone")
        expect(page.locator("#banner")).to_contain_text("goes on trying")
        picture(page, "gone")
        demo.start()
        expect(page.locator("#state")).to_have_text("measuring")
        expect(peak).to_contain_text("Hz")
        expect(page.locator("#banner")).to_be_hidden()
        running.stop()
        expect(page.locator("#state")).to_have_text("no server")
        expect(page.locator("#banner")).to_contain_text("vdms-rt view")
        running.start()
        expect(page.locator("#state")).to_have_text("measuring")
        value = page.locator("#x-value").inner_text()
        expect(page.locator("#x-value")).not_to_have_text(value)
        page.click("#tab-run")
        expect(page.locator("#events")).to_contain_text("arrived")


def test_it_serves_nothing_to_another_site(tmp_path: Path) -> None:
    with server(tmp_path, free_endpoint()) as running:
        with urllib.request.urlopen(running.url) as answer:
            assert "script-src 'self'" in answer.headers["Content-Security-Policy"]
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert not re.search(rb"""(?:src|href)=["']?(?:https?:)?//""", answer.read())
        foreign = {"Origin": "http://evil.example"}
        for headers, path in [
            ({"Host": "evil.example"}, ""),
            (foreign, "feed"),
            (foreign, "ask/demo/find"),
            ({"Content-Type": "text/plain"}, "ask/demo/find"),
        ]:
            data = b"{}" if path.startswith("ask") else None
            request = urllib.request.Request(running.url + path, data=data, headers=headers)
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request)
            assert refused.value.code in (403, 415), (headers, path)
            refused.value.close()


def test_what_cannot_be_asked_is_refused_in_words(tmp_path: Path) -> None:
    with server(tmp_path, free_endpoint()) as running:
        for path, data, code, says in [
            ("ask/demo/explode", b"{}", 404, "not known"),
            ("ask/demo/find", b"nonsense", 400, "Expecting value"),
            ("ask/demo/find", b'{"who": "me"}', 400, "has the fields"),
            ("ask/demo/zero", b'{"marker": 7}', 502, "station"),
        ]:
            request = urllib.request.Request(
                running.url + path, data=data, headers={"Content-Type": "application/json"}
            )
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request)
            with refused.value as answer:
                told = json.loads(answer.read())
            assert (refused.value.code, told["done"]) == (code, False), path
            assert says in told["text"]


def test_a_port_that_is_taken_is_said_in_one_sentence(tmp_path: Path) -> None:
    with server(tmp_path, free_endpoint()) as running:
        second = type(running)(running.arguments, log=tmp_path / "second.log")
        with pytest.raises(AssertionError):
            second.start()
        assert second.process is not None
        second.process.communicate()
        assert second.process.returncode == 1
        assert second.log.read_text().endswith("name another --port or --host\n")
        assert second.log.read_text().count("\n") == 1
