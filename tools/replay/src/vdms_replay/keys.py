"""Keys of the terminal that steer the player."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator

from vdms_replay.player import Player

POLL_S = 0.2
STEP_S = 5.0
LEAP_S = 60.0
HELP = "space pause, left/right 5 s, down/up 60 s, home start, +/- speed, q quit"

KEYS: dict[bytes, Callable[[Player], None]] = {
    b" ": lambda player: player.pause(not player.standing().paused),
    b"\x1b[D": lambda player: player.skip(-STEP_S),
    b"\x1b[C": lambda player: player.skip(STEP_S),
    b"\x1b[B": lambda player: player.skip(-LEAP_S),
    b"\x1b[A": lambda player: player.skip(LEAP_S),
    b"\x1b[H": lambda player: player.seek(0.0),
    b"\x1b[1~": lambda player: player.seek(0.0),
    b"+": lambda player: player.set_speed(player.standing().speed * 2),
    b"-": lambda player: player.set_speed(player.standing().speed / 2),
    b"q": lambda player: player.quit(),
}


@contextlib.contextmanager
def steering(player: Player) -> Iterator[None]:
    """Let the keys of this terminal steer `player`, and show where it is, while the context lasts;
    without a terminal do nothing."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        yield
        return
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    stop = threading.Event()
    thread = threading.Thread(target=_listen, args=(fd, player, stop), name="keys")
    tty.setcbreak(fd)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
        sys.stderr.write("\n")


def _listen(fd: int, player: Player, stop: threading.Event) -> None:
    while not stop.is_set():
        if select.select([fd], [], [], POLL_S)[0]:
            for key in split(os.read(fd, 64)):
                if key in KEYS:
                    KEYS[key](player)
        width = shutil.get_terminal_size().columns
        sys.stderr.write(f"\r{line(player)[: width - 1]}\x1b[K")
        sys.stderr.flush()


def split(typed: bytes) -> list[bytes]:
    """Return the keys in what a terminal sent: single bytes, and escape sequences whole."""
    keys = []
    while typed:
        length = 1
        if typed.startswith(b"\x1b["):
            length = 2
            while length < len(typed) and not 0x40 <= typed[length] <= 0x7E:
                length += 1
            length += 1
        keys.append(typed[:length])
        typed = typed[length:]
    return keys


def line(player: Player) -> str:
    """Return one line that says where the player is."""
    at = player.standing()
    word = "ended" if at.ended else "paused" if at.paused else "playing"
    return f"{word:<8}{at.position_s:10.2f} s of {at.length_s:.2f} s   x {at.speed:g}   {HELP}"
