"""Calibrations, laws and probe sequences on topics of their own; requests and states contain only their identities."""

import contextlib
from dataclasses import dataclass, field

from google.protobuf.message import DecodeError

from lowfc.contract.codecs.calibration_codec import decode_calibration
from lowfc.contract.codecs.law_codec import law_of
from lowfc.contract.messages import CALIBRATION, LAW, PLAY, Topic, floats, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.command_channels import PlayTable, play_table

TOPICS = (CALIBRATION, LAW, PLAY)


@dataclass(slots=True)
class Published:
    """Calibrations, laws and probe sequences received so far, by identity (a hash of the content)."""

    calibrations: dict[str, Calibration] = field(default_factory=dict)
    laws: dict[str, LinearLaw] = field(default_factory=dict)
    plays: dict[str, PlayTable] = field(default_factory=dict)

    def store(self, topic: Topic, payload: bytes) -> None:
        """Store a received message of `TOPICS`; ignore an incomplete or damaged one: its identity stays unknown."""
        with contextlib.suppress(DecodeError, ValueError):
            if topic is CALIBRATION:
                calibration = decode_calibration(wire.Calibration.FromString(payload))
                self.calibrations[calibration.id] = calibration
            elif topic is LAW:
                law = law_of(wire.LinearLaw.FromString(payload))
                self.laws[law.id] = law
            elif topic is PLAY:
                play = wire.Play.FromString(payload)
                table = play_table(play.target, floats(play.table, -1, play.columns or 1), floats(play.basis, -1))
                self.plays[table.id] = table
