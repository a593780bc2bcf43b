"""Arrays that the controller publishes by themselves, by identity: requests and states name them."""

import contextlib
from dataclasses import dataclass, field

from google.protobuf.message import DecodeError

from lowfc.contract.codecs.calibration_codec import decode_calibration
from lowfc.contract.codecs.law_codec import law_of, table_of
from lowfc.contract.messages import CALIBRATION, LAW, PLAY, Topic, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.command_channels import PlayTable

TOPICS = (CALIBRATION, LAW, PLAY)


@dataclass(slots=True)
class Published:
    """Calibrations, laws and tables that can be played, as far as they were received."""

    calibrations: dict[str, Calibration] = field(default_factory=dict)
    laws: dict[str, LinearLaw] = field(default_factory=dict)
    plays: dict[str, PlayTable] = field(default_factory=dict)

    def take(self, topic: Topic, payload: bytes) -> None:
        """Keep one of them; one that is not whole is left out, and whoever needs it says so."""
        with contextlib.suppress(DecodeError, ValueError):
            if topic is CALIBRATION:
                calibration = decode_calibration(wire.Calibration.FromString(payload))
                self.calibrations[calibration.id] = calibration
            elif topic is LAW:
                law = law_of(wire.LinearLaw.FromString(payload))
                self.laws[law.id] = law
            elif topic is PLAY:
                table = table_of(wire.Play.FromString(payload))
                self.plays[table.id] = table
