"""The configs that kjax ships, by name."""

import difflib
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from kjax.config.loading import ConfigError

_PACKAGE = Path(__file__).resolve().parents[1]
# Inside the installed package, or beside it in a checkout.
_FOLDER = next((f for f in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if f.is_dir()), None)


def shipped_config(name: str) -> Path:
    """Path of a shipped config, such as ``trot_velocity`` or ``sweeps/push_trot.toml``.

    Raises:
      ConfigError: where there is none of that name, or kjax was installed without them.
    """
    if _FOLDER is None:
        raise ConfigError(f"{name}: this kjax, in {_PACKAGE}, was installed without its configs")
    path = _FOLDER / (name if name.endswith(".toml") else f"{name}.toml")
    if path.is_file():
        return path
    near = difflib.get_close_matches(name.removesuffix(".toml"), shipped_names(), n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise ConfigError(f"{name}: no such config in {_FOLDER}{hint}")


def shipped_names() -> list[str]:
    """Names of all shipped configs, those of sweeps with ``sweeps/`` before them."""
    if _FOLDER is None:
        return []
    files = (file.relative_to(_FOLDER) for file in _FOLDER.rglob("*.toml"))
    return sorted((f.with_suffix("").as_posix() for f in files), key=lambda n: ("/" in n, n))


def described() -> Iterator[tuple[str, str]]:
    """Each shipped config's name and the first sentence of the comment that it begins with."""
    for name in shipped_names():
        lines = shipped_config(name).read_text(encoding="utf-8").splitlines()
        comment = []
        for line in lines:
            if not line.startswith("#"):
                break
            comment.append(line.lstrip("# "))
        first = re.split(r"(?<!Fig)\. ", " ".join(comment))[0]
        yield name, textwrap.shorten(first.rstrip("."), 100, placeholder=" ...")


def find_config(name: str) -> Path:
    """The file that a user names: one of his own, or a shipped one.

    Raises:
      ConfigError: where there is neither.
    """
    path = Path(name)
    if path.is_file() or path.is_dir():
        return path
    try:
        return shipped_config(name)
    except ConfigError:
        if path.suffix == ".toml" or len(path.parts) > 2:
            return path  # whose absence is told with the nearest file beside it
        raise
