"""Log lines on a terminal."""

from vdms_rt.console import wrapped


def test_long_lines_are_broken_at_spaces_and_go_on_under_the_text() -> None:
    text = (
        "12:00:00 the marker moves; the reference is taken as soon as it rests\n  scale       1.5"
    )
    assert wrapped(text, 41).splitlines() == [
        "12:00:00 the marker moves; the reference",
        "         is taken as soon as it rests",
        "  scale       1.5",
    ]


def test_a_path_stays_whole_and_an_empty_line_stays() -> None:
    path = "/a/rather/long-path/to/a-recording.mcap"
    assert wrapped(f"recording into {path}\n\nend", 30).splitlines() == [
        "recording into",
        f"         {path}",
        "",
        "end",
    ]
