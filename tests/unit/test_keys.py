"""Keys and passwords, as files and as sentences; test_network_access tries what they open."""

import ipaddress
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from vdms_rt import cli
from vdms_rt.wire.keys import KeysError, client_tls, server_tls, users_file


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    status = cli.run(["keys", *map(str, words)])
    said = capsys.readouterr()
    return status, said.out, said.err


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_the_station_s_certificate_names_its_computer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    status, out, _ = run(capsys, "server", "192.168.1.20", "lab.local", "--folder", folder)
    assert status == 0
    assert f'keys = "{folder}"' in out
    assert server_tls(str(folder))["enable_mtls"] is True
    own = certificate(folder / "server.pem")
    own.verify_directly_issued_by(certificate(folder / "ca.pem"))
    names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.IPAddress) == [ipaddress.ip_address("192.168.1.20")]
    assert names.get_values_for_type(x509.DNSName) == ["lab.local"]
    usage = own.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert not own.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


def test_a_client_s_folder_has_all_and_nothing_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "server", "localhost", "--folder", tmp_path)
    status, out, _ = run(capsys, "client", "ann", "bob", "--folder", tmp_path)
    assert status == 0
    folder = tmp_path / "clients" / "ann"
    assert str(folder) in out
    assert sorted(p.name for p in folder.iterdir()) == ["ca.pem", "client-key.pem", "client.pem"]
    assert client_tls(str(folder))["enable_mtls"] is True
    own = certificate(folder / "client.pem")
    own.verify_directly_issued_by(certificate(tmp_path / "ca.pem"))
    assert own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == "ann"
    usage = own.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH]


def test_secrets_are_readable_by_their_owner_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    run(capsys, "server", "localhost", "--folder", folder)
    run(capsys, "client", "ann", "--folder", folder)
    run(capsys, "password", "bob", "--folder", folder)
    secret = ("ca-key.pem", "server-key.pem", "clients/ann/client-key.pem", "users.txt")
    assert {mode(folder / name) for name in secret} == {0o600}
    assert {mode(folder / name) for name in ("", "clients/ann")} == {0o700}
    assert mode(folder / "ca.pem") == 0o644


def test_a_new_certificate_keeps_the_authority(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "server", "one", "--folder", tmp_path)
    before = (tmp_path / "ca.pem").read_bytes(), (tmp_path / "server.pem").read_bytes()
    run(capsys, "server", "two", "--folder", tmp_path)
    assert (tmp_path / "ca.pem").read_bytes() == before[0]
    assert (tmp_path / "server.pem").read_bytes() != before[1]


def test_a_password_is_made_up_told_once_and_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, first, _ = run(capsys, "password", "ann", "bob", "--folder", tmp_path)
    _, second, _ = run(capsys, "password", "ann", "--folder", tmp_path)
    lines = Path(users_file(str(tmp_path / "users.txt"))).read_text().splitlines()
    assert [line.split(":")[0] for line in lines] == ["bob", "ann"]
    told = [line.rsplit(" ", 1)[1] for line in (*first.splitlines(), *second.splitlines())
            if "with the password" in line]  # fmt: skip
    assert len(set(told)) == 3
    assert lines == [f"bob:{told[1]}", f"ann:{told[2]}"]


def test_a_password_can_be_typed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("getpass.getpass", lambda _: "sword fish")
    _, out, _ = run(capsys, "password", "ann", "--ask", "--folder", tmp_path)
    assert "sword fish" not in out
    assert (tmp_path / "users.txt").read_text() == "ann:sword fish\n"
    monkeypatch.setattr("getpass.getpass", lambda _: "a:b")
    status, _, err = run(capsys, "password", "ann", "--ask", "--folder", tmp_path)
    assert status == 1
    assert err == ('vdms-rt: a password is of printable characters without ":"; choose another\n')


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("server", "no name"), '"no name" is neither the name nor the address of a computer'),
        (("client", "../x"), '"../x" is not a name here'),
        (("client", "ann"), "`vdms-rt keys server` makes the authority in this folder first"),
        (("password", "a:b"), '"a:b" is not a name here'),
    ],
)
def test_what_cannot_be_made_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], sentence: str
) -> None:
    status, out, err = run(capsys, *words, "--folder", tmp_path)
    assert (status, out) == (1, "")
    assert len(err.splitlines()) == 1
    assert sentence in err
    assert not list(tmp_path.rglob("*.pem"))


def test_what_cannot_be_used_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(KeysError, match="`vdms-rt keys server` makes it"):
        server_tls(str(tmp_path))
    with pytest.raises(KeysError, match="`vdms-rt keys client` makes it"):
        client_tls(str(tmp_path))
    with pytest.raises(KeysError, match="`vdms-rt keys password NAME` makes it"):
        users_file(str(tmp_path / "users.txt"))
    (tmp_path / "users.txt").write_text("ann secret\n")
    with pytest.raises(KeysError, match="not a file of users"):
        users_file(str(tmp_path / "users.txt"))
