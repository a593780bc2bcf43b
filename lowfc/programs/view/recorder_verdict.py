"""Judgement on the recording: is this night kept."""

from pathlib import PurePath

from lowfc.contract.messages import Role
from lowfc.programs.view.tile import Level, Tile, ago, counted, short
from lowfc.programs.view.watcher import RECENT_S, Life, Watcher


def recorder(watcher: Watcher) -> Tile:
    """Whether the run is recorded, and if not, why."""
    title, sign = "RECORDER", watcher.recorder()
    heard = watcher.moment.health.get(Role.RECORDER) if watcher.moment else None
    if heard is None:
        return Tile(title, "NONE", "there is no recorder: nothing is recorded", Level.NEUTRAL)
    done = heard.health.recording
    log = short(PurePath(done.file).stem)
    if done.failure:
        advice = f"Recording failed, the loop goes on: {short(done.failure)}. Make room and start `lowfc record` again."
        return Tile(title, "FAILED", short(done.failure), Level.BAD, advice)
    if sign.life is Life.SILENT:
        since = ago(sign.silent_s)
        advice = f"Recorder silent for {since}: the run is not recorded, the loop goes on. Start `lowfc record` again."
        return Tile(title, "DEAD", f"silent for {since}: nothing is recorded", Level.BAD, advice)
    if sign.life is Life.STOPPED:
        alone = watcher.controller().life in (Life.RUNNING, Life.STARTING)
        detail = f"{log} is complete; nothing is recorded now" if alone else f"{log} is complete"
        advice = "The recorder was stopped, the loop goes on: nothing is recorded. Start `lowfc record` again."
        return Tile(title, "STOPPED", detail, Level.WARNING if alone else Level.NEUTRAL, advice)
    if done.stopped:
        advice = "Recording was stopped by an operator: the night is not kept. `lowfc ctl record start` goes on."
        return Tile(title, "STOPPED", f"not recording since {log} was finished", Level.WARNING, advice)
    if lost := watcher.recent("lost"):
        messages = counted(lost, "message")
        advice = f"The recorder lost {messages} in the last {RECENT_S:g} s: disk or processor is too slow for it."
        return Tile(title, "LOSING", f"{messages} in {RECENT_S:g} s, {done.lost} in all", Level.BAD, advice)
    if not done.file:
        return Tile(title, "WAITING", "no log yet", Level.NEUTRAL)
    losses = f"{counted(done.lost, 'message')} lost" if done.lost else "nothing lost"
    return Tile(title, "RECORDING", f"{log}, {losses}", Level.GOOD)
