"""``nsmodel completion``: a script that lets a shell complete commands, options, files and cases, made from the parser."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from nsmodel import shelf
from nsmodel.cli.settings import Commands
from nsmodel.cli.status import DONE
from nsmodel.solve.choose import SOLVERS

HOW = """Print a script for a shell. Written once, and again after an upgrade:

  bash: mkdir -p ~/.local/share/bash-completion/completions
        nsmodel completion bash > ~/.local/share/bash-completion/completions/nsmodel
  zsh:  nsmodel completion zsh > ~/.nsmodel.zsh
        and in ~/.zshrc, after compinit: source ~/.nsmodel.zsh
  fish: nsmodel completion fish > ~/.config/fish/completions/nsmodel.fish"""

BASH = """# Completes nsmodel; written by: nsmodel completion {shell}
{before}_nsmodel() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD - 1]}}" words="" files=""
    local cases="{cases}"
    COMPREPLY=()
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{commands} --help --version"
    else
        case "${{COMP_WORDS[1]}} $before" in
{values}
            *) case "${{COMP_WORDS[1]}} $word" in
{others}
            esac ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
    if [ -n "$files" ]; then
        local IFS=$'\\n'
        COMPREPLY+=($(compgen -d -- "$word") $(compgen -f -X '!*.py' -- "$word"))
        compopt -o filenames 2> /dev/null
    fi
}}
complete -o default -F _nsmodel nsmodel
"""
BEFORE = {"bash": "", "zsh": "autoload -U +X bashcompinit && bashcompinit\n"}
SPACE = " " * 12


class Argument(NamedTuple):
    """What a command takes: ``names`` of an option, none of what has no name; ``words`` to choose from, if there are such.

    ``value`` is "" of an option that takes none, else its name in the help.
    """

    names: tuple[str, ...]
    words: tuple[str, ...]
    value: str
    help: str


def add(commands: Commands) -> None:
    """Add the command; it describes all commands that are there."""
    parser = commands.add_parser(
        "completion", help="print a script that completes in a shell", description=HOW,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("shell", choices=["bash", "zsh", "fish"], help="the shell")
    parser.set_defaults(command=lambda arguments: _completion(arguments.shell, commands))


def _completion(shell: str, commands: Commands) -> int:
    known = {name: list(_arguments(parser)) for name, parser in commands.choices.items()}
    about = {choice.dest: choice.help or "" for choice in commands._choices_actions}
    print(_fish(known, about) if shell == "fish" else _bash(known, shell), end="")
    return DONE


def _arguments(parser: argparse.ArgumentParser) -> Iterator[Argument]:
    for action in parser._actions:
        value = "" if action.nargs == 0 else str(action.metavar or action.dest)
        yield Argument(tuple(action.option_strings), tuple(map(str, action.choices or ())), value, action.help or "")


def _bash(known: dict[str, list[Argument]], shell: str) -> str:
    values, others = [], []
    for command, arguments in known.items():
        after: dict[str, list[str]] = {}  # What may follow an option: the options.
        for one in arguments:
            if one.value and one.names:
                after.setdefault(f'words="{_words(one)}"' if _words(one) else "return", []).extend(one.names)
        values += [f"{SPACE}{_pattern(command, names)}) {what} ;;" for what, names in after.items()]
        options = " ".join(name for one in arguments for name in one.names)
        others.append(f'{SPACE}    "{command} -"*) words="{options}" ;;')
        for one in arguments:
            if not one.names:
                files = " files=1" if one.value == "FILE" else ""
                others.append(f'{SPACE}    "{command} "*) words="{_words(one)}"{files} ;;')
    return BASH.format(
        shell=shell, before=BEFORE[shell], cases=" ".join(shelf.files()), commands=" ".join(known),
        values="\n".join(values), others="\n".join(others),
    )  # fmt: skip


def _pattern(command: str, names: list[str]) -> str:
    return "|".join(f'"{command} {name}"' for name in names)


def _words(one: Argument) -> str:
    """What there is to choose from; the shell's variable ``cases`` where cases are."""
    return "$cases" if one.value in ("FILE", "CASE") else " ".join(SOLVERS if one.value == "SOLVER" else one.words)


def _fish(known: dict[str, list[Argument]], about: dict[str, str]) -> str:
    lines = ["# Completes nsmodel; written by: nsmodel completion fish", f"set -l cases {' '.join(shelf.files())}"]
    for command, arguments in known.items():
        lines.append(f"complete -c nsmodel -n __fish_use_subcommand -f -a {command} -d {_quoted(about.get(command, ''))}")
        for one in arguments:
            line = f"complete -c nsmodel -n '__fish_seen_subcommand_from {command}'"
            for name in one.names:
                line += f" -l {name[2:]}" if name.startswith("--") else f" -s {name[1:]}"
            if one.names and one.value:
                line += " -x" if _words(one) else " -r"
            elif not one.names and one.value != "FILE":
                line += " -f"
            if _words(one):
                line += f' -a "{_words(one)}"'
            lines.append(f"{line} -d {_quoted(one.help)}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
