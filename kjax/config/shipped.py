"""The configs that kjax ships, by name."""

import difflib
from pathlib import Path

from kjax.config.loading import ConfigError

_FOLDER = Path(__file__).resolve().parents[2] / "configs"


def shipped_config(name: str) -> Path:
    """Path of a shipped config, such as ``trot_velocity.toml`` or ``sweeps/push_trot.toml``.

    Raises:
      ConfigError: where there is none of that name, or kjax was installed without them.
    """
    path = _FOLDER / name
    if path.is_file():
        return path
    if not _FOLDER.is_dir():
        raise ConfigError(
            f"{name}: this kjax, in {_FOLDER.parent}, was installed without its configs; clone "
            "the repository and install it from there with: pip install -e ."
        )
    known = [file.relative_to(_FOLDER).as_posix() for file in _FOLDER.rglob("*.toml")]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise ConfigError(f"{name}: no such config in {_FOLDER}{hint}")
