"""``kjax configs``: the shipped configs, or the text of one, to begin one's own with."""

from collections.abc import Sequence
from dataclasses import dataclass

from kjax.config.shipped import described, shipped_config
from kjax.options import ConfigName, Options, fail, parse


@dataclass(kw_only=True)
class ConfigsOptions(Options):
    """Options of the list."""

    name: ConfigName = None
    """Print this one: kjax configs trot_velocity > my.toml."""


def main(argv: Sequence[str] | None = None) -> int:
    """Print the names with a sentence each, or one config."""
    args = parse(ConfigsOptions, argv, "The shipped configs, or the text of one.")
    if args.name is None:
        for name, text in described():
            print(f"{name:26} {text}")
        return 0
    try:
        text = shipped_config(args.name).read_text(encoding="utf-8")
    except ValueError as error:
        fail(str(error))
    if args.out is None:
        print(text, end="")
    else:
        args.out.write_text(text, encoding="utf-8")
    return 0
