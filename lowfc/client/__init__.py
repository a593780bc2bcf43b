"""Python client of a running loop: the operator's requests, and the loop's frames and control steps (one per frame).

with Client() as loop:
    loop.gain(0.4, modes=[2, 3])
    since = loop.offset(5.0, modes=[4]).frame_sequence
    errors_nm = [step.error_nm for step in loop.steps(200) if step.frame_sequence >= since]
"""

from lowfc.client.answer import Answer
from lowfc.client.client import Client
from lowfc.client.configuration import configuration_of
from lowfc.client.mirror_watch import MirrorWatch
from lowfc.client.runs import running, the_run
from lowfc.client.stream import Frame, Stream
from lowfc.control.loop.inputs import Step

__all__ = ["Answer", "Client", "Frame", "MirrorWatch", "Step", "Stream", "configuration_of", "running", "the_run"]
