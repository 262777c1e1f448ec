"""A station that publishes numbered samples at 60 Hz until it is ended.

Arguments: ADDRESS SESSION RECOVER_S.
"""

import itertools
import sys
import time

from loopback import publisher, say

RATE_HZ = 60.0


def main(endpoint: str, session: str, recover_s: str) -> None:
    with publisher(endpoint, recover_s=float(recover_s)) as station:
        begin_s = time.monotonic()
        for seq in itertools.count():
            say(station, seq, session=int(session))
            if seq == 0:
                sys.stdout.write("up\n")
                sys.stdout.flush()
            time.sleep(max(begin_s + (seq + 1) / RATE_HZ - time.monotonic(), 0))


if __name__ == "__main__":
    main(*sys.argv[1:])
