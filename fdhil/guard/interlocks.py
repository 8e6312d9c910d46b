"""Lists the interlocks: the reaction, cause and next action of each class, and the facts the daemon must attest."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum


class Reaction(IntEnum):
    """The guard's reaction; a higher one takes precedence."""

    REFUSE = 0
    HOLD = 1
    RAMP_DOWN = 2
    FREEZE = 3


REACTION_EFFECTS: Mapping[Reaction, str] = {
    Reaction.REFUSE: "nothing is sent",
    Reaction.HOLD: "the offset is held for a few cycles, then ramped to zero",
    Reaction.RAMP_DOWN: "the offset is ramped to zero and the correction is off until it is armed again",
    Reaction.FREEZE: "nothing can be sent: the last offset may still be applied",
}


@dataclass(frozen=True, slots=True)
class Alarm:
    """A condition that stops or refuses a correction: its class, its axis and a detail.

    ``late`` describes how late this computer was just before, where that explains what a drive shows.
    """

    code: str
    axis: str = ""
    detail: str = ""
    late: str = ""

    @property
    def reaction(self) -> Reaction:
        """The guard's reaction to it while it sends."""
        return INTERLOCK_CATALOGUE[self.code][0]

    @property
    def cause(self) -> str:
        """The cause as a clause."""
        where = f"axis {self.axis}: " if self.axis else ""
        shown = f"{where}{INTERLOCK_CATALOGUE[self.code][1]}" + (f" ({self.detail})" if self.detail else "")
        return f"{self.late}, therefore {shown}" if self.late else shown

    @property
    def action(self) -> str:
        """The operator's next action."""
        if self.code == "NotOff" and self.detail == "FROZEN":
            return "hold the feed, then run fdhil adopt"
        if self.late and self.reaction is not Reaction.FREEZE:
            return INTERLOCK_CATALOGUE["PcLate"][2]
        return INTERLOCK_CATALOGUE[self.code][2]

    def sentence(self, off: bool = False) -> str:
        """Return cause, effect on the machine (``off``: nothing is applied any more) and next action."""
        effect = "the correction is off and nothing is applied" if off else REACTION_EFFECTS[self.reaction]
        return f"{self.cause}; {effect}; {self.action}"


Alarms = tuple[Alarm, ...]
LATE_PC = "this PC was late"
_R, _H, _F, _N = Reaction.RAMP_DOWN, Reaction.HOLD, Reaction.FREEZE, Reaction.REFUSE
# class: (reaction while sending, cause, next action)
INTERLOCK_CATALOGUE: Mapping[str, tuple[Reaction, str, str]] = {
    # the bus
    "BusOff": (_F, "the CAN controller is bus-off", "hold the feed, check cable and termination, then adopt"),
    "ErrorPassive": (_R, "the CAN controller is error-passive", "check cable, termination and bit rate"),
    "BusRestarted": (_F, "the CAN controller restarted by itself", "hold the feed, then adopt"),
    "BusDown": (_F, "the CAN bus is down", "hold the feed, restore the interface (a hub: restart the guard), adopt"),
    "TxQueueFull": (_R, "frames do not leave the transmit queue", "check that another node acknowledges"),
    "RxOverflow": (_R, "frames were lost before they were read", "give the guard a real-time priority"),
    "LoopOverrun": (_R, "the guard's loop was late for more than ten cycles", "give the guard a real-time priority"),
    "SyncLost": (_F, "no SYNC is received", "hold the feed, restore the NC's SYNC, then adopt"),
    "SyncJitter": (_H, "SYNC does not keep its period", "check sync_period_s and the NC's SYNC producer"),
    "SyncCollision": (_R, "the SYNC counter jumps: there is a second producer", "remove the second SYNC producer"),
    # the drive
    "StaleData": (_R, "the drive's feedback is older than three SYNC", "check the drive and its TPDO mapping"),
    "FeedbackGap": (_H, "a feedback frame was lost", "check the bus load and the cable"),
    "TargetLost": (_H, "no new target (0x607A) came with this SYNC", "check that the NC streams its targets"),
    "HeartbeatLost": (_R, "the drive's heartbeat is missing", "check the drive and its heartbeat time (0x1017)"),
    "NmtStateWrong": (_F, "the drive is not Operational", "hold the feed, find the NMT master, then adopt"),
    "NodeRebooted": (_F, "the drive has rebooted", "hold the feed, run fdhil check with the NC off, then fdhil adopt"),
    "DriveNotEnabled": (_R, "the drive is not in Operation enabled", "clear its fault and enable it"),
    "NotFollowing": (_R, "the drive does not follow its demand (statusword bit 12)", "check the drive's limits"),
    "LimitActive": (_R, "an internal limit is active (statusword bit 11)", "leave the limit"),
    "FollowingError": (_R, "the following error exceeds half its window", "check load, gains and 0x6065"),
    "NotCsp": (_R, "the drive is not in cyclic synchronous position mode", "set 0x6060 to 8"),
    "ReadBackStale": (
        _R,
        "the drive does not report its offset (0x60B0), so that it is unknown",
        "check the drive and that one of its TPDOs maps 0x60B0",
    ),
    "EchoMismatch": (_R, "the drive's offset is not the one that was sent", "check the PDO mapping and the scaling"),
    "Implausible": (_R, "position and speed contradict each other", "check the mapping, find a second sender"),
    "DriveEmergency": (_R, "the drive sent an emergency message (EMCY)", "read its error code and clear it"),
    "PdoLength": (_R, "a PDO is shorter than its mapping", "compare the drive's mapping with the profile"),
    "PdoMapping": (_N, "a PDO is longer than its mapping", "compare the drive's mapping with the profile"),
    "StaleOffset": (_N, "the drive already holds an offset", "adopt it, so that it is ramped to zero"),
    "OffsetDoubtful": (
        _F,
        "the offset that the drive reports cannot be trusted",
        "hold the feed, switch the drive off and on, run fdhil check with the NC off, then fdhil adopt",
    ),
    # other nodes
    "ForeignProducer": (_R, "two nodes send as this drive or NC", "find and remove the second node"),
    "OffsetHijack": (
        _R,
        "another node writes the offset: by our COB-ID, by another RPDO of the drive or by SDO",
        "hold the feed, find and remove that node",
    ),
    "BusLocked": (_R, "another guard's heartbeat is on the bus", "stop the other guard"),
    # the path
    "Misaligned": (_H, "the targets differ from the table's path", "plan the correction for the program that runs"),
    "OverrideChanged": (_H, "the path is run at another rate than planned", "set the override of the plan"),
    "FeedHold": (_H, "the path stands still", "start the feed, or arm again"),
    "TableStarved": (_R, "less than one second of the streamed table is left", "see fdhil status for the cause"),
    "OffsetLimit": (_R, "an offset is beyond the limit, braking included", "plan the correction inside the limits"),
    "OffsetRate": (_R, "an offset changes too fast", "plan the correction inside the limits"),
    "OffsetEnergy": (_R, "the offsets travel more than allowed in one second", "plan a smoother correction"),
    "SoftwareLimit": (_N, "the path is too near to a software limit", "lower max_offset_um, or move the workpiece"),
    "PositionRange": (_N, "the path is too near to the 32-bit limit", "move the workpiece, or use coarser increments"),
    "CorruptFile": (_N, "the correction table cannot be read", "plan it again"),
    "TableBusy": (_N, "a whole table cannot be changed while a correction runs", "disarm, or adopt first"),
    "ProgramMismatch": (_N, "no table of this program is loaded", "plan and load the correction of this program"),
    # facts that the daemon attests
    "NotCommissioned": (_N, "there is no valid commissioning record", "run fdhil commission"),
    "RecordVoid": (
        _N,
        "the drive has rebooted or its settings have changed since it was commissioned",
        "switch the NC off and run fdhil check, which compares it again",
    ),
    "FeedforwardUnknown": (_N, "it is unknown whether the offset enters the feed-forward", "run fdhil commission"),
    "FeedforwardOff": (_N, "this drive is not set up for speed and torque offsets", "run fdhil commission"),
    "ModelNotValidated": (_N, "the model was not validated", "record a rapid move of each axis"),
    "ModelStale": (_R, "the model is too old, or the machine has changed since", "record a rapid move of each axis"),
    "PoorSkill": (_R, "predictions of the last moves were not good enough", "check load and gains, identify again"),
    "HarmPredicted": (_N, "the correction is not predicted to help", "leave it off, or plan another method"),
    "ReadOnlyStore": (_R, "the journal cannot be written", "make the store's disk writable"),
    "WatchdogNotArmed": (_N, "the drive's monitoring of the guard's heartbeat is not verified", "run fdhil commission"),
    "LimitBeyondWindow": (_N, "the largest offset exceeds a quarter of the window", "lower max_offset_um"),
    "AuthRequired": (_N, "the operator's token is missing or wrong", "use the token of the run directory"),
    # the guard itself
    "NotOff": (_N, "the previous correction has not ended", "disarm it first"),
    "NotSettled": (_N, "not all interlocks have been good for 100 SYNC cycles", "wait a moment and arm again"),
    "PcLate": (
        _N,
        "this PC reacts too late for a correction",
        "take load off this PC, give the guard a real-time priority, measure with fdhil doctor --latency 60, arm again",
    ),
    "GuardBusy": (_N, "a request of this connection is still pending", "wait for its answer, then ask again"),
    "DisarmedSince": (_N, "the correction was disarmed after this request was made", "repeat the request if needed"),
    "MainLost": (_R, "the daemon is gone or does not answer", "restart the daemon, then arm again"),
    "Disarmed": (_R, "disarmed", "arm again when needed"),
    "Stopped": (_R, "the guard was stopped", "start it again when needed"),
    "Finished": (_R, "the path is finished", "arm the next program"),
    "InternalError": (_F, "the guard has found an internal error", "report it with the journal"),
}

# facts that the daemon must attest for arming, and the class of the refusal
FACTS: Mapping[str, str] = {
    "commissioned": "NotCommissioned",
    "offset_in_feedforward_known": "FeedforwardUnknown",
    "model_validated": "ModelNotValidated",
    "model_fresh": "ModelStale",
    "skill_enough": "PoorSkill",
    "gain_positive": "HarmPredicted",
    "journal_writable": "ReadOnlyStore",
    "watchdog_proven": "WatchdogNotArmed",
}
# the same for the on-line feed-forward, which needs no program
FEEDFORWARD_FACTS: Mapping[str, str] = {
    "commissioned": "NotCommissioned",
    "feedforward_commissioned": "FeedforwardOff",
    "model_validated": "ModelNotValidated",
    "model_fresh": "ModelStale",
    "journal_writable": "ReadOnlyStore",
    "watchdog_proven": "WatchdogNotArmed",
}
# those that the daemon may withdraw while a correction runs
WITHDRAWABLE = ("model_fresh", "skill_enough", "journal_writable")
