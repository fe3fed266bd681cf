"""Finished results in a folder, each under a key of all that it depends on.

A key is a hash of inputs (configs as resolved, the content of the files that they name, plain data)
and of the code that computes, a study's own file included. So

- nothing is shown that was computed from other inputs or by other code;
- nothing that is finished is dropped: results of other inputs stay under their own keys until
  ``clear``;
- each ``add`` writes a file of its own, whole or not at all: a killed run keeps what it had
  finished, and two runs on one folder do no harm;
- a damaged file is named, and only its results are computed again once it is deleted.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from kjax import cli
from kjax.config import to_dict
from kjax.files import file_hashes
from kjax.options import fail

_PACKAGE = Path(__file__).resolve().parents[1]
_NO_PHYSICS = ("viz", "runs", "bench", "studies", "cli.py")  # what cannot change an episode


class CacheError(RuntimeError):
    """A folder or file that cannot be used or written; the message names it and the cure."""


class Cache:
    """Results by key; ``cache[key]``, ``key in cache``.

    Attributes:
      folder: where files of the cache lie.
    """

    def __init__(self, folder: Path, *code: Path, fresh: bool = False):
        """Open the cache of a folder, or begin it.

        Args:
          folder: of the run or study.
          code: files besides the package that compute results, such as a study's own.
          fresh: whether to ``clear`` it first.

        Raises:
          CacheError: for a file that is damaged.
        """
        self.folder = folder / "cache"
        self._code = code_version(*code)
        self._values: dict[str, Any] = {}
        self._read: set[Path] = set()
        if fresh:
            self.clear()
        self.refresh()

    def key(self, *inputs: Any) -> str:
        """Key of a result: hash of inputs and code.

        Args:
          inputs: configs, and plain data.
        """
        parts = [_inputs(one) for one in inputs]
        return _hash([self._code, *parts])

    def __contains__(self, key: str) -> bool:
        """Whether the result is there."""
        return key in self._values

    def __getitem__(self, key: str) -> Any:
        """The result; ``KeyError`` if it is not there."""
        return self._values[key]

    def __len__(self) -> int:
        """Number of results that this code computed."""
        return len(self._values)

    def add(self, results: Mapping[str, Any]) -> None:
        """Keep results: plain data by key, in one file.

        Raises:
          CacheError: if it cannot be written; what was kept before stays.
        """
        plain = cli.plain(dict(results))
        path = self.folder / f"{self._code}-{_hash(sorted(plain))}.json"
        text = json.dumps({"sha256": _hash(plain), "results": plain}, allow_nan=False)
        self._write(path, text.encode())
        self._values |= json.loads(text)["results"]
        self._read.add(path)

    def refresh(self) -> None:
        """Read what other processes have added since.

        Raises:
          CacheError: for a file that is damaged.
        """
        for path in sorted(self.folder.glob(f"{self._code}-*.json")):
            if path in self._read:
                continue
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
                results, sum_ = content["results"], content["sha256"]
            except (ValueError, KeyError, TypeError):
                results, sum_ = None, ""
            if not isinstance(results, dict) or _hash(results) != sum_:
                raise CacheError(
                    f"{path}: damaged; delete it and run again: only its results are computed again"
                )
            self._values |= results
            self._read.add(path)

    def path(self, key: str, suffix: str) -> Path:
        """A file of the cache for what belongs to a result: a series, a checkpoint."""
        return self.folder / f"{key}{suffix}"

    def arrays(self, key: str) -> dict[str, np.ndarray] | None:
        """What ``add_arrays`` kept, or ``None``.

        Raises:
          CacheError: for a file that is damaged.
        """
        path = self.path(key, ".npz")
        if not path.exists():
            return None
        try:
            with np.load(path, allow_pickle=False) as data:
                return dict(data)
        except Exception as error:  # zip, zlib and numpy raise a dozen types for damaged bytes
            raise CacheError(
                f"{path}: damaged ({error}); delete it and run again: only it is computed again"
            ) from None

    def add_arrays(self, key: str, arrays: Mapping[str, Any]) -> None:
        """Keep arrays under a key."""
        path = self.path(key, ".npz")
        self.folder.mkdir(parents=True, exist_ok=True)
        scratch = path.with_name(f".{path.stem}.{os.getpid()}.npz")
        np.savez_compressed(scratch, **arrays)
        scratch.replace(path)

    def clear(self) -> None:
        """Drop everything, results of other inputs and code included."""
        for path in self.folder.glob("*"):
            path.unlink()
        self._values, self._read = {}, set()

    def _write(self, path: Path, content: bytes) -> None:
        scratch = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with scratch.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            scratch.replace(path)
        except OSError as error:
            with suppress(OSError):
                scratch.unlink(missing_ok=True)
            raise CacheError(
                f"{path}: cannot be written ({error.strerror or error}); what was finished is "
                "kept, run again to go on"
            ) from None


def open_cache(folder: Path, *code: Path, fresh: bool = False) -> Cache:
    """A script's ``Cache``: a damaged one ends the program with one line."""
    try:
        return Cache(folder, *code, fresh=fresh)
    except CacheError as error:
        fail(str(error))


@contextmanager
def lock(folder: Path, name: str = "lock") -> Iterator[None]:
    """Keep a folder to this process; the system frees it however the process ends.

    Raises:
      CacheError: if another process has it.
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / f".{name}", timeout=0):
            yield
    except Timeout:
        raise CacheError(
            f"{folder} is in use by another run; wait for it, or give --out another folder"
        ) from None


def code_version(*files: Path) -> str:
    """Hash of everything that an episode's result depends on besides its config.

    Args:
      files: that a result depends on as well, such as a study's own.
    """
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*")):
        inside = path.relative_to(_PACKAGE)
        if path.suffix in (".py", ".xml") and inside.parts[0] not in _NO_PHYSICS:
            digest.update(inside.as_posix().encode() + path.read_bytes())
    for file in files:
        digest.update(file.name.encode() + file.read_bytes())
    for package in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"):
        with suppress(PackageNotFoundError):
            digest.update(f"{package} {version(package)}".encode())
    return digest.hexdigest()[:16]


def _inputs(one: Any) -> Any:
    """An input as plain data: a config with the content of the files that it names."""
    if dataclasses.is_dataclass(one) and not isinstance(one, type):
        return [to_dict(one), file_hashes(one)]
    return cli.plain(one)


def _hash(data: Any) -> str:
    text = json.dumps(data, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
