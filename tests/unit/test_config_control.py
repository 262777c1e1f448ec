"""What is wrong with a configuration of control is said in one sentence."""

from pathlib import Path

import pytest
from loopback import free_endpoint

from vdms_rt.config import Control, Publish, parse_config
from vdms_rt.model import ConfigError
from vdms_rt.publish import Publisher, PublishError


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            '[control]\nlisten = ["tls/0.0.0.0:7448"]',
            "lab.toml: control: listen needs keys; `vdms-rt keys --help` tells how to make it",
        ),
        (
            '[control]\npassword_listen = ["tcp/0.0.0.0:7449"]',
            "lab.toml: control: password_listen needs users; "
            "`vdms-rt keys --help` tells how to make it",
        ),
        (
            '[control]\nkeys = "keys"\nlisten = ["tcp/0.0.0.0:7448"]',
            'lab.toml: control: listen = "tcp/0.0.0.0:7448": only tls asks for a certificate; '
            'write for example "tls/0.0.0.0:7448"',
        ),
        (
            "[control]\nthrough_router = true",
            'lab.toml: configuration: control.through_router needs publish.mode = "client": '
            "a station that listens itself would let everyone control who reaches it",
        ),
    ],
)
def test_what_does_not_go_together_is_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as fault:
        parse_config(text, "lab.toml")
    assert str(fault.value) == sentence


def test_keys_that_are_not_there_are_one_sentence(tmp_path: Path) -> None:
    control = Control(listen=("tls/127.0.0.1:7448",), keys=str(tmp_path))
    station = Publisher(
        Publish(listen=(free_endpoint(),)), "s1", ["m1"], sample_rate_hz=60.0, control=control
    )
    with pytest.raises(PublishError) as fault:
        station.__enter__()
    assert str(fault.value) == (
        f"control.keys: {tmp_path / 'ca.pem'}: cannot be read: No such file or directory; "
        "`vdms-rt keys server` makes it"
    )
