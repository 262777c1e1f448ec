"""Records samples and pixels as fast as a camera gives them, until it is killed.

Says each on stdout as `seq monotonic_ns`. Run by the tests: python kill_writer.py DIRECTORY
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from logbook import PIXELS, put_sample, recorder_for

from vdms_rt.wire import topics
from vdms_rt.wire import vdms_pb2 as pb

PICTURES_PER_S = 200


def main() -> None:
    recorder, _ = recorder_for(Path(sys.argv[1]), rotate_s=1.0)
    threading.Thread(target=recorder.run, name="record").start()
    pixels = bytes(range(256)) * 100
    seq = 0
    while True:
        assert put_sample(recorder, seq)
        data = pb.Pixels(frame_seq=seq, patches=[pb.Patch(data=pixels)]).SerializeToString()
        assert recorder.put(topics.PIXELS, PIXELS, 1_000_000 * seq, data)
        sys.stdout.write(f"{seq} {time.monotonic_ns()}\n")
        sys.stdout.flush()
        seq += 1
        time.sleep(1 / PICTURES_PER_S)


main()
