"""The words of a command line: options of a command by tyro, keys of its config by their names.

A command's options are the fields of a dataclass, with a docstring below each for the help. Where
the command takes a config, every key of it is an option too: ``--lmpc.horizon 10``. A mistake ends
the program with exit code 2 and one line.
"""

import contextlib
import dataclasses
import io
import re
import sys
import tomllib
import typing
import warnings
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeAlias, TypeVar

import tyro

from kjax.config import GaitConfig, RunConfig, fields, load_config
from kjax.config.gaits import LIBRARY
from kjax.config.loading import nearest_key, replacement_of
from kjax.config.shipped import find_config
from kjax.robots import get_robot

Given = TypeVar("Given", bound="Options")

# Options that may be left out: what the help shows for their value, and no "default: None".
Count: TypeAlias = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
File: TypeAlias = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
Text: TypeAlias = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
ConfigName: TypeAlias = Annotated[
    str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[CONFIG]", help_behavior_hint="")
]

_program: list[str] = []  # what the help calls the program, the innermost last


def fail(message: str) -> NoReturn:
    """Print one line to stderr and end with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


@contextlib.contextmanager
def program(name: str) -> Iterator[None]:
    """Call the program so in the help of what is parsed inside, such as ``kjax run``."""
    _program.append(name)
    try:
        yield
    finally:
        _program.pop()


def called() -> str:
    """What the program is called now: by ``program``, else the script's name."""
    return _program[-1] if _program else Path(sys.argv[0]).name


@dataclasses.dataclass(kw_only=True)
class Options:
    """Options that every command has."""

    # What the command takes its config as, of which every key is an option; None: it takes none.
    config_type: ClassVar[type | None] = None

    out: File = None
    """Output folder (default: in results/)."""


@dataclasses.dataclass(kw_only=True)
class RunOptions(Options):
    """Options of a command that takes the config of a run."""

    config_type = RunConfig

    config: ConfigName = None
    """A shipped config's name (kjax configs lists them) or a TOML file; the defaults without it."""


@dataclasses.dataclass(kw_only=True)
class StudyOptions(Options):
    """Options of a command that runs many episodes; ``names`` of its parts are a class's own."""

    names: ClassVar[tuple[str, ...]] = ()

    only: tuple[str, ...] = ()
    """Parts to run; all if left out."""

    jobs: int = 2
    """Worker processes, one core each."""

    base: Literal["planar", "free", "both"] = "both"
    """Of the trunk."""

    quick: bool = False
    """Few short episodes: to check the script."""

    @property
    def bases(self) -> tuple[str, ...]:
        """Those that are asked for."""
        return ("planar", "free") if self.base == "both" else (self.base,)


def parse(options: type[Given], argv: Sequence[str] | None, description: str) -> Given:
    """The options of a command that takes no keys of a config; a mistake ends the program.

    Args:
      options: dataclass of them.
      argv: words of the command line; of this process if ``None``.
      description: of the command, for the help.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    _, words = _split(words, options, {})
    if issubclass(options, StudyOptions):
        description += f"\n\nParts: {', '.join(options.names)}."
    found = _by_tyro(options, words, description)
    if isinstance(found, StudyOptions):
        require_names(found, "only", found.names)
        found.only = found.only or found.names
        require(found, "jobs", least=1)
    return found


def parse_config(
    options: type[Given], argv: Sequence[str] | None, description: str
) -> tuple[Any, Given]:
    """Config and options of a command that takes one; a mistake ends the program.

    Args:
      options: dataclass of them; its ``config_type`` says what kind of config.
      argv: words of the command line; of this process if ``None``.
      description: of the command, for the help.
    """
    cls = options.config_type
    assert cls is not None
    words = list(sys.argv[1:] if argv is None else argv)
    if "--help-config" in words:
        print(keys_help(cls))
        raise SystemExit(0)
    given, words = _split(words, options, {name for name, _, _ in fields(cls)})
    description += (
        "\n\nEvery key of the config is an option too, its value written as in TOML: "
        "--lmpc.horizon 10; --help-config lists them."
    )
    found = _by_tyro(options, words, description)
    try:
        file = getattr(found, "config", None)
        path = None if file is None else find_config(file)
        config: Any = load_config(cls, path, {key: _value(text) for key, text in given.items()})
        if isinstance(config, RunConfig):
            _require_walkable(config)
    except ValueError as error:
        fail(str(error))
    return config, found


def _by_tyro(options: type[Given], words: Sequence[str], description: str) -> Given:
    """The options that tyro makes of the words; its errors in one line."""
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                options,
                args=words,
                prog=called(),
                description=description,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as end:
        if end.code in (0, None):
            raise
        fail(_one_line(errors.getvalue()) or "the command line cannot be read")


def _one_line(text: str) -> str:
    """What tyro says of a mistake, without its box, its advice and its repetitions."""
    text = " ".join(re.sub(r"[╭╮╰╯│─]+", " ", text).split())
    for end in (" Argument helptext", " Got errors", " For full helptext"):
        text = text.split(end)[0]
    return re.sub(r"^(Parsing error|Value error|Error parsing|Required options|\s)+", "", text)


def _split(
    words: Sequence[str], options: type[Options], keys: Collection[str]
) -> tuple[dict[str, str], list[str]]:
    """Keys of the config with the texts of their values, and the other words."""
    own = {field.name for field in dataclasses.fields(options)} | {"help"}
    given: dict[str, str] = {}
    rest: list[str] = []
    waiting = iter(words)
    for word in waiting:
        name, has_value, text = word.removeprefix("--").partition("=")
        if not word.startswith("--") or name.replace("-", "_") in own:
            rest.append(word)
        elif name in keys or (keys and _of_own_gait(name)):
            value = text if has_value else next(waiting, None)
            if value is None or (not has_value and value.startswith("--")):
                fail(f"--{name}: a value is missing")
            given[name] = value
        else:
            _fail_unknown(name, [*keys, *(option.replace("_", "-") for option in own)])
    return given, rest


def _fail_unknown(name: str, known: Sequence[str]) -> NoReturn:
    became = replacement_of(name)
    if became:
        fail(f"--{name}: {became}")
    near = nearest_key(name, known)
    fail(f"unknown option --{name}" + (f"; did you mean --{near}?" if near else ""))


def _of_own_gait(name: str) -> bool:
    """Whether it is the key of a gait that the library has not."""
    section, _, key = name.rpartition(".")
    gait = section.removeprefix("gaits.")
    return (
        section.startswith("gaits.")
        and gait not in LIBRARY
        and key in {own for own, _, _ in fields(GaitConfig)}
    )


def _require_walkable(config: RunConfig) -> None:
    """Raise a ValueError for a config that no controller can be made from, before it takes long."""
    from kjax.controllers.resolve_model import resolve_model
    from kjax.controllers.walkable import check_walkable

    resolve_model(config.koopman)
    with warnings.catch_warnings(action="ignore"):  # said again when the controller is made
        check_walkable(config, get_robot(config.robot).params)


def _value(text: str) -> Any:
    """A command-line value read as TOML, or as a plain string where it is none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def require(
    options: Any, *names: str, least: float | None = None, above: float | None = None
) -> None:
    """End the program where an option is out of range; one that was not given passes."""
    for name in names:
        value, option = getattr(options, name), f"--{name.replace('_', '-')}"
        if value is None:
            continue
        if least is not None and not value >= least:
            fail(f"{option}: got {value}, wanted at least {least:g}")
        if above is not None and not value > above:
            fail(f"{option}: got {value}, wanted more than {above:g}")


def require_names(options: Any, name: str, known: Collection[str]) -> None:
    """End the program where an option names something that is not among the known."""
    for given in getattr(options, name):
        if given not in known:
            option = f"--{name.replace('_', '-')}"
            fail(f"{option}: got '{given}', wanted some of {', '.join(known)}")


def keys_help(cls: type) -> str:
    """All keys of a config, by section: type, what it is, unit and default."""
    sections: dict[str, list[str]] = {}
    for name, info, default in fields(cls):
        section = name.rpartition(".")[0]
        if section.startswith("gaits.") and section != "gaits.trot":
            continue  # the same keys for each of them
        shown = list(default) if isinstance(default, tuple) else default
        lines = sections.setdefault(section or "run", [])
        lines.append(f"  --{name} {_type_name(info.annotation)}")
        lines.append(f"      {info.description} default: {shown}")
    title = {"gaits.trot": f"gaits.NAME, of {', '.join(LIBRARY)}, or your own"}
    return "\n\n".join(
        "\n".join([f"[{title.get(section, section)}]", *lines])
        for section, lines in sections.items()
    )


def _type_name(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return "{" + ",".join(str(option) for option in typing.get_args(annotation)) + "}"
    if typing.get_origin(annotation) is tuple:
        return "LIST"
    return getattr(annotation, "__name__", "VALUE").upper()
