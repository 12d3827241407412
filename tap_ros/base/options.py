# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Options of a command from a dataclass: a field is an option, its `:param` line is its help.

tyro reads them. Settings that the package uses without a command line stay free of it; a command
takes them as a field. A field that is a dataclass has a box of its own in --help.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import GenericAlias
from typing import Annotated, Any, cast, get_args

from tap_ros.base.errors import ConfigError
from tap_ros.base.text import listing
import tyro
from tyro import conf
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo


def default_text(default: str) -> str:
    """Return what --help says of a default; of an empty one that there is none."""
    return '(default: none)' if default in ('', "''", 'None') else f'(default: {default})'


Bags = Annotated[tuple[str, ...], conf.arg(metavar='BAG [BAG ...]')]
File = Annotated[str, conf.arg(metavar='FILE', help_behavior_hint=default_text)]
Flag = Annotated[bool, conf.FlagCreatePairsOff]  # without --no-...
Folder = Annotated[str, conf.arg(metavar='FOLDER', help_behavior_hint=default_text)]
ShippedFile = Annotated[str, conf.arg(  # its own place is long, and other on each machine
    metavar='FILE', help_behavior_hint='(default: the shipped ones)')]
Topic = Annotated[str, conf.arg(metavar='TOPIC', help_behavior_hint=default_text)]

_STYLE = (conf.OmitArgPrefixes, conf.OmitSubcommandPrefixes, conf.HelptextFromCommentsOff)
_RULES = ConstructorRegistry()


def parse(kind: Any, words: Sequence[str], prog: str = 'python -m tap_ros',
          description: str | None = None, default: Any = None) -> Any:
    """
    Make options from words.

    :param kind: dataclass, or a union of them with tyro.conf.subcommand.
    :param words: list of strings.
    :param prog: what the command is called in --help.
    :param description: what it does, in --help; by default the summary of the dataclass.
    :param default: what stands for words that are missing, an object of that kind.
    :return: an object of that kind.
    :raises SystemExit: with code 2 for words that it cannot be made from, which are printed; with
        code 0 after --help, and after what prints shell completion.
    """
    return tyro.cli(kind, args=words, prog=prog, description=description, config=_STYLE,
                    registry=_RULES, default=tyro.MISSING_NONPROP if default is None else default)


def check_different(option: str, values: Sequence[str]) -> None:
    """Raise ConfigError for a value of an option that is given twice."""
    if twice := sorted({value for value in values if values.count(value) > 1}):
        raise ConfigError(f'{option}: {listing(twice)} is given twice; give it once')


def one_of(choices: Iterable[str]) -> PrimitiveConstructorSpec[str]:
    """
    Return what makes a str in Annotated an option with choices.

    :param choices: names, such as the keys of a dict. Where they are written down but here, a
        Literal is simpler.
    """
    names = tuple(choices)
    return PrimitiveConstructorSpec(
        nargs=1, metavar='{' + ','.join(names) + '}', instance_from_str=lambda words: words[0],
        is_instance=lambda value: value in names, str_from_instance=lambda value: [value],
        choices=names)


@_RULES.primitive_rule
def _at_least_one(info: PrimitiveTypeInfo) -> Any:
    """Let an option that is a tuple of any length need a value; one that is a list does not."""
    kinds: tuple[Any, ...] = get_args(info.type) if info.type_origin is tuple else ()
    if kinds[1:] != (...,) or conf.UseAppendAction in info.markers:
        return None
    spec = ConstructorRegistry.get_primitive_spec(
        PrimitiveTypeInfo.make(cast(Any, GenericAlias(list, kinds[0])), info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec

    def convert(words: list[str]) -> tuple[Any, ...]:
        if not words:
            raise ValueError('expected at least one value')
        return tuple(spec.instance_from_str(words))

    one = spec.metavar[1:-1].split(' [')[0]
    return replace(spec, metavar=f'{one} [{one} ...]', instance_from_str=convert,
                   is_instance=lambda values: isinstance(values, tuple))
