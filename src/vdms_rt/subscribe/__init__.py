"""The few lines that another program needs to listen to stations.

for sample in subscribe("vdms/*/*/displacement", connect="tcp/192.168.1.20:7447"):
    print(sample.station, sample.marker, sample.value.x_mm)
"""

from vdms_rt.subscribe.samples import Arrived, Left, Missed, Notice, Sample, Unreadable
from vdms_rt.subscribe.subscription import Listener, SubscribeError, Subscription, subscribe

__all__ = [
    "Arrived",
    "Left",
    "Listener",
    "Missed",
    "Notice",
    "Sample",
    "SubscribeError",
    "Subscription",
    "Unreadable",
    "subscribe",
]
