"""The kinds of config files, told apart by their top-level keys."""

from collections.abc import Mapping
from typing import Any

from kjax.config.run import FitStudyConfig, RunConfig
from kjax.config.sweep import SweepConfig

# Config class -> what a file of this kind is, and what takes it.
KINDS: dict[type, tuple[str, str]] = {
    RunConfig: ("a closed-loop run", "experiments/closed_loop.py"),
    SweepConfig: ("a sweep", "experiments/sweep.py"),
    FitStudyConfig: ("a fit study", "experiments/koopman_fit.py"),
}


def other_kind(data: Mapping[str, Any], wanted: type) -> str | None:
    """One sentence, if the keys of a file are rather those of another kind of config.

    Args:
      data: content of the file.
      wanted: config class that it was read as.
    """
    if wanted not in KINDS:
        return None
    known = {cls: sum(key in cls.__pydantic_fields__ for key in data) for cls in KINDS}  # type: ignore[attr-defined]
    best = max(known, key=lambda cls: (known[cls], cls is wanted))
    if best is wanted:
        return None
    kind, command = KINDS[best]
    return f"is the file of {kind}, which {command} takes; wanted that of {KINDS[wanted][0]}"
