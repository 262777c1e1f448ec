from fractions import Fraction
from pathlib import Path

import pytest

from vdms_rt.config import Config, effective_values, load_config, parse_config
from vdms_rt.model import ConfigError, Region


def refusal(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "lab.toml")
    return str(caught.value).splitlines()


def test_an_empty_file_is_a_whole_configuration() -> None:
    config = parse_config("", "lab.toml")
    assert config == Config()
    assert config.source == "v4l2"
    assert [m.name for m in config.marker] == ["m1"]


def test_the_default_sheet_lists_its_circles_from_top_left_to_bottom_right() -> None:
    shape = Config().marker[0].shape
    assert shape.circles_mm == ((-60, 60), (60, 60), (-60, -60), (60, -60))


def test_every_error_is_told_at_once_with_file_key_value_and_rule() -> None:
    lines = refusal(
        'sorce = "table"\n'
        "[table]\ndistanse_m = 3\nfill = 4\n"
        '[table.motion]\nkind = "circle"\n'
        '[[marker]]\nname = "m1"\n'
        '[[marker]]\nname = "m2"\nspacing_mm = "wide"\n'
    )
    assert sorted(lines) == [
        'lab.toml: marker[2].spacing_mm = "wide": input should be a valid number',
        "lab.toml: sorce: unknown key; did you mean source?",
        "lab.toml: table.distanse_m: unknown key; did you mean distance_m?",
        "lab.toml: table.fill = 4: input should be less than or equal to 1",
        "lab.toml: table.motion.kind = \"circle\": input should be 'still', 'harmonic', 'sweep', "
        "'step' or 'record'",
    ]


def test_a_key_like_no_other_gets_the_list_of_known_ones() -> None:
    assert refusal("[station]\nqqqq = 1") == [
        "lab.toml: station.qqqq: unknown key; known here: name"
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('source = "clip"', 'source = "clip" needs clip.path'),
        ('source = "log"', 'source = "log" needs log.path'),
        ('[[marker]]\nfind = "regions"', "needs one region for each of the 4 circles"),
        ("[[marker]]\n[[marker]]", "two markers are named m1"),
        ("[[marker]]\ncircles_mm = [[0, 0], [99, 0], [0, 99]]", "at least 4 are needed"),
        ("[[marker]]\nspacing_mm = 40", "circles 1 and 2 touch"),
        ('[publish]\nmode = "client"', "needs publish.connect"),
        ('source = "table"\n[[table.sheet]]\nmarker = "m9"', "which no [[marker]] defines"),
        ('[station]\nname = "a/b"', "station.name"),
        ("[table]\nfill = nan", "table.fill"),
        ('[clip]\nrate_hz = "30000/0"', 'a fraction such as "30000/1001"'),
        ("[process]\nring_slots = 8", "greater than or equal to 64"),
        ("source =", "not valid TOML"),
    ],
)
def test_each_contradiction_has_its_sentence(text: str, said: str) -> None:
    assert said in "\n".join(refusal(text))


def test_rates_are_exact_fractions() -> None:
    for text in ('"30000/1001"', "29.97", "25"):
        rate = parse_config(f"[clip]\nrate_hz = {text}", "lab.toml").clip.rate_hz
        assert rate == Fraction(text.strip('"'))


def test_regions_are_read_in_order() -> None:
    config = parse_config(
        '[[marker]]\nfind = "regions"\n'
        "regions_px = [[1, 2, 30, 40], [5, 6, 70, 80], [1, 1, 9, 9], [2, 2, 9, 9]]",
        "lab.toml",
    )
    assert config.marker[0].regions[1] == Region(5, 6, 70, 80)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.toml: cannot read the configuration"):
        load_config(tmp_path / "absent.toml")
    (tmp_path / "latin.toml").write_bytes(b'[station]\nname = "\xe9"')
    with pytest.raises(ConfigError, match="byte 18 is not UTF-8"):
        load_config(tmp_path / "latin.toml")


def test_effective_values_name_every_key() -> None:
    text = effective_values(Config())
    for key in ("chain_delay_ms", "rotate_mb", "stamp_jitter_ms", "rate_hz"):
        assert f'"{key}"' in text


CONFIG_DIRECTORY = Path(__file__).parents[2] / "config"


def test_the_commented_file_holds_every_default() -> None:
    config, text = load_config(CONFIG_DIRECTORY / "vdms-rt.toml")
    assert config == Config()
    for section in [Config, *(f.annotation for f in Config.model_fields.values())]:
        for key in getattr(section, "model_fields", {}):
            assert f"{key} = " in text or f"{key}]" in text, key


def test_the_demo_is_a_correct_configuration() -> None:
    config, _ = load_config(CONFIG_DIRECTORY / "demo.toml")
    assert config.source == "table"
