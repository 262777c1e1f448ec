"""The section [lens]: bounds, and one file for several configurations."""

from __future__ import annotations

import pytest

from vdms_rt.config import Config, Lens, effective_values, parse_config
from vdms_rt.model import ConfigError


def lens_in(text):
    return parse_config(text, "lab.toml").lens


def refusal(text):
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "lab.toml")
    return str(caught.value)


def test_a_lens_is_read_with_its_centre():
    lens = lens_in("[lens]\nk1 = -0.05\nk2 = 0.01\ncentre_px = [350, 240.5]\npixel_aspect = 1.0")
    assert lens == Lens(k1=-0.05, k2=0.01, centre_px=(350.0, 240.5), pixel_aspect=1.0)


def test_without_a_section_the_lens_bends_nothing():
    assert (lens_in("").k1, lens_in("").k2, lens_in("").centre_px) == (0.0, 0.0, None)


def test_a_file_takes_the_place_of_the_keys_and_is_in_the_values_in_force(tmp_path):
    file = tmp_path / "lens.toml"
    file.write_text("# a comment\n[lens]\nk1 = -0.05\ncentre_px = [350, 240]\n")
    config = parse_config(f'[lens]\nfile = "{file}"', "lab.toml")
    assert config.lens == Lens(k1=-0.05, centre_px=(350.0, 240.0))
    file.unlink()
    assert Config.model_validate_json(effective_values(config)) == config


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[lens]\nk1 = 0.3", "lens.k1: input should be less than or equal to 0.2"),
        ("[lens]\nk3 = 0.3", "lens.k3: extra inputs are not permitted"),
        ("[lens]\nk1 = 0.2\nk2 = 0.2", "lens: k1 = 0.2 with k2 = 0.2 folds the picture over"),
        ('[lens]\nfile = "b.toml"', "lens.file = 'b.toml': names yet another file"),
        ("lens = 3", "lens: input should be an object"),
        ("k1 = 0.1", "not a TOML with a section [lens]; `vdms-rt lens` prints such a file"),
        ("[lens", "not a TOML with a section [lens]"),
    ],
)
def test_a_wrong_lens_file_is_named_with_its_fault(tmp_path, content, said):
    file = tmp_path / "lens.toml"
    file.write_text(content)
    assert f"lab.toml: lens: {file}: {said}" in refusal(f'[lens]\nfile = "{file}"')


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[lens]\nfile = "absent.toml"', "lens: absent.toml: cannot be read"),
        (
            '[lens]\nfile = "a.toml"\nk2 = 0.0\nk1 = 0.0',
            "file = 'a.toml' is read in place of k1, k2; leave out one or other",
        ),
        ("[lens]\nk1 = -0.21", "lens.k1 = -0.21: input should be greater than or equal to -0.2"),
        ("[lens]\nk1 = 0.1\nk2 = 0.15", "folds the picture over before its corner"),
        ("[lens]\nk1 = -0.2\nk2 = 0.2\npixel_aspect = 0", "lens.pixel_aspect = 0"),
        ("[lens]\ncentre_px = [1]", "lens.centre_px[2]: field required"),
        ("[[marker]]\naxis_deg = 181", "marker[1].axis_deg = 181"),
    ],
)
def test_each_wrong_value_has_its_sentence(text, said):
    assert said in refusal(text)
