"""Look: what moves on the page is what the station measured."""

import re
from collections.abc import Callable, Iterator

import pytest
from browsing import DEADLINE_S, Server, Station, opened, server, station
from playwright.sync_api import Browser, Page, expect

from vdms_rt.model import Displacement
from vdms_rt.subscribe import subscribe

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

MINUS = "\N{MINUS SIGN}"


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Station, Server]]:
    directory = tmp_path_factory.mktemp("look")
    with (
        station(directory, moving=True) as running,
        server(directory, running.endpoint) as page_server,
    ):
        yield running, page_server


@pytest.fixture
def page(chrome: Browser, moving: tuple[Station, Server]) -> Iterator[Page]:
    with opened(chrome, moving[1].url) as window:
        expect(window.locator("#marker")).to_contain_text("m1")
        window.select_option("#marker", "m1")
        yield window


def number(page: Page, selector: str) -> float:
    return float(page.locator(selector).inner_text().replace(MINUS, "-").split()[0])


def test_the_plot_moves_as_the_table_does(page: Page, picture: Callable[[Page, str], None]) -> None:
    expect(page.locator("#state")).to_have_text("measuring")
    first = page.locator("#peaks li").first
    expect(first).to_have_text(re.compile(r"^(0\.9[89]|1\.0[012])\d Hz  (9\.[89]|10\.[01])\d mm$"))
    span = page.locator("#x-numbers dd").nth(2)
    expect(span).to_have_text(re.compile(r"^(19\.[6-9]|20\.[0-4])\d\d mm$"))
    rms = page.locator("#x-numbers dd").nth(3)
    expect(rms).to_have_text(re.compile(r"^(7\.[01]|6\.9)\d\d mm$"))
    assert abs(number(page, "#y-value")) < 0.2
    before = page.locator("#x-value").inner_text()
    expect(page.locator("#x-value")).not_to_have_text(before)
    canvas = page.locator("#x-plot canvas")
    drawn = canvas.evaluate("canvas => canvas.toDataURL()")
    page.wait_for_function(
        "drawn => document.querySelector('#x-plot canvas').toDataURL() !== drawn", arg=drawn
    )
    picture(page, "look")


def test_the_cursor_tells_the_samples_that_another_subscriber_gets(
    page: Page, moving: tuple[Station, Server]
) -> None:
    expect(page.locator("#peaks li").first).to_contain_text("Hz")
    page.click("#pause")
    expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
    box = page.locator("#x-plot .u-over").bounding_box()
    assert box is not None
    told = {}
    for part in (0.5, 0.6, 0.7, 0.8):
        page.mouse.move(box["x"] + part * box["width"], box["y"] + box["height"] / 2)
        expect(page.locator("#cursor")).to_contain_text("seq")
        text = page.locator("#cursor").inner_text()
        found = re.search(rf"x ([+{MINUS}][\d.]+)\s+y ([+{MINUS}][\d.]+) mm\s+seq (\d+)", text)
        assert found, text
        told[int(found[3])] = found[1].replace(MINUS, "-"), found[2].replace(MINUS, "-")
    with subscribe("vdms/*/m1/displacement", connect=moving[0].endpoint) as samples:
        true = {}
        while not true or max(true) < max(told):
            sample = samples.get(DEADLINE_S)
            assert sample is not None
            assert isinstance(sample.value, Displacement)
            true[sample.value.seq] = sample.value
    for seq, (x, y) in told.items():
        assert abs(float(x) - true[seq].x_mm) < 1e-4
        assert abs(float(y) - true[seq].y_mm) < 1e-4


def test_it_zooms_pauses_and_goes_on_by_mouse_and_keyboard(
    page: Page, picture: Callable[[Page, str], None]
) -> None:
    expect(page.locator("#peaks li").first).to_contain_text("Hz")
    box = page.locator("#x-plot .u-over").bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.6 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.8 * box["width"], middle, steps=4)
    page.mouse.up()
    expect(page.locator("#pause")).to_have_text("Go on")
    page.mouse.move(box["x"] + 0.5 * box["width"], middle)
    expect(page.locator("#cursor")).to_contain_text("seq")
    picture(page, "zoomed")
    page.keyboard.press("l")
    expect(page.locator("#pause")).to_have_text("Pause")
    page.keyboard.press("Space")
    expect(page.locator("#pause")).to_have_text("Go on")
    page.keyboard.press("Space")
    page.get_by_role("radio", name="30 s").click()
    expect(page.get_by_role("radio", name="30 s")).to_have_attribute("aria-checked", "true")
    page.locator("#tab-look").focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#tab-setup")).to_have_attribute("aria-selected", "true")
    expect(page.locator("#setup")).to_be_visible()


@pytest.mark.parametrize(
    ("name", "width", "height", "scheme"),
    [("tablet", 1024, 768, "light"), ("dark", 1280, 720, "dark")],
)
def test_nothing_is_cut_off_on_a_tablet_and_in_the_dark(
    chrome: Browser,
    moving: tuple[Station, Server],
    picture: Callable[[Page, str], None],
    name: str,
    width: int,
    height: int,
    scheme: str,
) -> None:
    with opened(chrome, moving[1].url, width=width, height=height, scheme=scheme) as page:
        expect(page.locator("#peaks li").first).to_contain_text("Hz")
        assert page.evaluate("document.documentElement.dataset.theme") == scheme
        for tab in ("look", "setup", "run"):
            page.click(f"#tab-{tab}")
            wider = page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert wider <= 0, tab
        page.click("#tab-look")
        picture(page, name)
        page.click("#theme")
        assert page.evaluate("document.documentElement.dataset.theme") != scheme


def test_who_opens_it_later_sees_what_was_before(
    chrome: Browser, moving: tuple[Station, Server]
) -> None:
    with opened(chrome, moving[1].url) as first:
        expect(first.locator("#peaks li").first).to_contain_text("Hz")
    with opened(chrome, moving[1].url) as second:
        # The whole span is there at once, and not only what came since it was opened.
        expect(second.locator("#x-numbers dd").nth(2)).to_have_text(
            re.compile(r"^(19\.[6-9]|20\.[0-4])\d\d mm$"), timeout=DEADLINE_S * 1000
        )


def test_spectrum_tells_a_sine_with_holes_in_it(page: Page) -> None:
    """Frequency and amplitude of two sines that are no multiples of the line spacing."""
    found = page.evaluate(
        """async () => {
          const { spectrum, peaks } = await import("/static/spectrum.js");
          const t = [], v = [];
          for (let i = 0; i < 1800; i++) {
            if (i % 97 === 5) continue;
            const s = i / 59.94;
            t.push(1.8e9 + s);
            const sine = (hz) => Math.sin(2 * Math.PI * hz * s);
            v.push(i % 61 ? 3 + 10 * sine(1.037) + 0.5 * sine(7.411) : NaN);
          }
          return peaks(spectrum(t, v, 1 / 59.94), 3);
        }"""
    )
    assert [round(peak["hz"], 2) for peak in found[:2]] == [1.04, 7.41]
    assert found[0]["amplitude"] == pytest.approx(10.0, rel=0.01)
    assert found[1]["amplitude"] == pytest.approx(0.5, rel=0.05)


def test_no_time_is_cut_off_at_the_plots_edge(page: Page) -> None:
    labels = page.evaluate(
        """async () => {
            const { whole } = await import("/static/timeplot.js");
            const at = (x) => whole(
                { bbox: { width: 600 * devicePixelRatio }, valToPos: () => x }, 0, "16:57:45");
            return [at(500), at(577), at(590), at(600)];
        }"""
    )
    assert labels == ["16:57:45", "16:57:45", "", ""]


def test_store_keeps_ten_minutes_and_does_not_grow(page: Page) -> None:
    kept = page.evaluate(
        """async () => {
          const { Store } = await import("/static/store.js");
          const store = new Store();
          for (let at = 0; at < 150000; at += 1000) {
            const t_s = Float64Array.from({ length: 1000 }, (_, i) => (at + i) / 60);
            const zero = new Float32Array(1000);
            const seq = t_s.map((s) => Math.round(s * 60)), x = t_s.map((s) => s % 7);
            const status = new Uint32Array(1000);
            const still = { y: zero, sigma_x: zero, sigma_y: zero, status };
            store.add({ count: 1000, t_s, seq, x, ...still });
          }
          const x = store.between("x", 2000, 2010);
          const ends = [store.oldest("t_s"), store.newest("seq")];
          return [store.count, store.t_s.length, ...ends, store.rate_hz(), x.length, x[60]];
        }"""
    )
    assert kept[:2] == [36001, 131072]
    assert kept[2:4] == [pytest.approx(149999 / 60 - 600, abs=0.02), 149999]
    assert kept[4] == pytest.approx(60)
    assert kept[5:] == [600, pytest.approx(2001 % 7, abs=1e-6)]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_stands_out_as_wcag_aa_asks(
    chrome: Browser, moving: tuple[Station, Server], scheme: str
) -> None:
    """WCAG 2.2, 1.4.3: 4.5 to 1 between a text and what is behind it."""
    pairs = [("ink", "card"), ("ink", "ground"), ("muted", "card"), ("muted", "ground")]
    pairs += [(name, "card") for name in ("x", "y", "warn", "bad", "accent")]
    pairs += [("pill-ink", name) for name in ("good", "warn", "bad", "muted")]
    pairs += [("accent-ink", "accent"), ("ground", "ink"), ("warn", "ground")]
    with opened(chrome, moving[1].url, scheme=scheme) as page:
        colours = page.evaluate(
            """(names) => Object.fromEntries(names.map((name) => {
              const part = document.createElement("i");
              part.style.color = `var(--${name})`;
              document.body.append(part);
              const rgb = getComputedStyle(part).color.match(/[0-9.]+/g).slice(0, 3).map(Number);
              part.remove();
              return [name, rgb];
            }))""",
            sorted({name for pair in pairs for name in pair}),
        )
    for text, behind in pairs:
        low, high = sorted(luminance(colours[name]) for name in (text, behind))
        assert (high + 0.05) / (low + 0.05) >= 4.5, (text, behind)


def luminance(rgb: list[float]) -> float:
    """Return the relative luminance of sRGB, as WCAG defines it."""
    linear = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb)
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
