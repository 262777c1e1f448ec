"""A subscriber that prints a line for whatever comes until it is ended: ADDRESS [KEY]."""

import sys

from vdms_rt.model import Displacement
from vdms_rt.subscribe import Missed, Sample, subscribe


def main(endpoint: str, key: str = "vdms/*/*/displacement") -> None:
    with subscribe(key, endpoint, notices=True) as items:
        for item in items:
            match item:
                case Sample(value=Displacement() as d):
                    say("sample", d.session, d.seq)
                case Missed():
                    say("missed", item.session, item.first_seq, item.last_seq, item.on_the_way)
                case Sample():
                    say("other", item.topic)
                case _:
                    say(type(item).__name__.lower())


def say(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
