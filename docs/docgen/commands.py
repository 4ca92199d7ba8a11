"""docs/reference/commands.md: every command with its options, from the parsers themselves."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

from companion.cli import build_parser as companion_parser
from docgen.pages import table
from policies.cli import _parser as policies_parser
from sim_bridge.cli import _parser as sim_bridge_parser

PARSERS = {"companion": companion_parser, "sim-bridge": sim_bridge_parser, "policies": policies_parser}

_OF_THE_MACHINE = {"jobs": "the machine's cores"}


def commands(parser: argparse.ArgumentParser, summary: str = "") -> Iterator[tuple[argparse.ArgumentParser, str]]:
    """Every parser below ``parser`` that is a command by itself, with its line in the list of commands."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        yield parser, summary
    for action in inner:
        said = {choice.dest: choice.help or "" for choice in action._choices_actions}
        for name, each in action.choices.items():
            yield from commands(each, said.get(name, ""))


def page(program: str) -> str:
    """The commands of one program."""
    return "\n\n".join(_command(parser, summary) for parser, summary in commands(PARSERS[program]()))


def _command(parser: argparse.ArgumentParser, summary: str) -> str:
    about, examples = _split(parser)
    blocks = [f"### `{parser.prog}`"]
    if said := _sentence(about or summary):
        blocks.append(said)
    blocks.append(_options(parser))
    if examples:
        blocks.append("```sh\n" + "\n".join(examples) + "\n```")
    return "\n\n".join(blocks)


def _split(parser: argparse.ArgumentParser) -> tuple[str, list[str]]:
    """What a parser's description and epilog say, and the example commands among it."""
    about: list[str] = []
    examples: list[str] = []
    for line in f"{parser.description or ''}\n{parser.epilog or ''}".splitlines():
        text = re.sub(r"^\s*examples?:\s*", "", line).strip()
        if text.startswith(tuple(f"{program} " for program in PARSERS)):
            examples.append(re.sub(r"\s{2,}", "  # ", text, count=1) if re.search(r"\S\s{2,}\S", text) else text)
        elif text:
            about.append(re.sub(r"^`[\w -]+`: ", "", text))
    own = [example for example in examples if example.startswith(f"{parser.prog} ")]
    return " ".join(about), own or examples


def _options(parser: argparse.ArgumentParser) -> str:
    rows = []
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        rows.append((_invocation(action), _default(action), _help(parser, action)))
    return table(("option", "default", "meaning"), rows) if rows else "No options."


def _invocation(action: argparse.Action) -> str:
    value = ""
    if action.nargs != 0:
        if action.metavar is not None:
            value = action.metavar if isinstance(action.metavar, str) else " ".join(action.metavar)
        elif action.choices is not None:
            value = "{" + ",".join(str(choice) for choice in action.choices) + "}"
        else:
            value = action.dest.upper()
    if not action.option_strings:
        return f"`{value}`" + (" (may be left out)" if action.nargs in ("?", "*") else "")
    names = ", ".join(f"`{name}{' ' + value if value else ''}`" for name in action.option_strings)
    more = [word for word, is_so in (("required", action.required), ("repeatable", _repeats(action))) if is_so]
    return names + (f" ({', '.join(more)})" if more else "")


def _repeats(action: argparse.Action) -> bool:
    return isinstance(action, argparse._AppendAction)


def _default(action: argparse.Action) -> str:
    nothing = action.default in (None, argparse.SUPPRESS, False, []) and action.default != 0
    if nothing or action.nargs == 0:
        return ""
    if callable(action.default) or action.dest in _OF_THE_MACHINE:
        return _OF_THE_MACHINE.get(action.dest, "")
    return f"`{action.default}`"


def _help(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    if not action.help:
        return ""
    text = parser._get_formatter()._expand_help(action)
    text = re.sub(r"\s*\(repeatable\)", "", text)
    if not _default(action):
        return text
    return re.sub(r"; default:? [^;)]*|\s*\(default:? [^()]*\)", "", text)


def _sentence(text: str) -> str:
    text = " ".join(text.split())
    return text and text[0].upper() + text[1:] + ("" if text.endswith((".", ":", "?")) else ".")
