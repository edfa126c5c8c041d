"""``nsmodel completion``: a script that lets a shell complete commands, options, files and cases, made from the parser."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from nsmodel.cli.common import EXIT_DONE, Commands
from nsmodel.modeling import model_files
from nsmodel.solvers.plan import STEP_SOLVERS

DESCRIPTION = """Print a script for a shell. Written once, and again after an upgrade:

  bash: mkdir -p ~/.local/share/bash-completion/completions
        nsmodel completion bash > ~/.local/share/bash-completion/completions/nsmodel
  zsh:  nsmodel completion zsh > ~/.nsmodel.zsh
        and in ~/.zshrc, after compinit: source ~/.nsmodel.zsh
  fish: nsmodel completion fish > ~/.config/fish/completions/nsmodel.fish"""

BASH_SCRIPT = """# Completes nsmodel; written by: nsmodel completion {shell}
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
SCRIPT_PREAMBLES = {"bash": "", "zsh": "autoload -U +X bashcompinit && bashcompinit\n"}
SCRIPT_INDENT = " " * 12  # Of the cases that are put into the script, which stand as deep as its own.


class CommandArgument(NamedTuple):
    """What a command takes: ``names`` of an option, none of what has no name; ``words`` to choose from, if there are such.

    ``value`` is "" of an option that takes none, else its name in the help.
    """

    names: tuple[str, ...]
    choices: tuple[str, ...]
    value: str
    help: str


def add_completion_command(commands: Commands) -> None:
    """Add the command; it describes all commands that are there."""
    parser = commands.add_parser(
        "completion", help="print a script that completes in a shell", description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("shell", choices=["bash", "zsh", "fish"], help="the shell")
    parser.set_defaults(command=lambda arguments: _print_completion(arguments.shell, commands))


def _print_completion(shell: str, commands: Commands) -> int:
    known = {name: list(_command_arguments(parser)) for name, parser in commands.choices.items()}
    about = {choice.dest: choice.help or "" for choice in commands._choices_actions}
    print(_fish_script(known, about) if shell == "fish" else _bash_script(known, shell), end="")
    return EXIT_DONE


def _command_arguments(parser: argparse.ArgumentParser) -> Iterator[CommandArgument]:
    for action in parser._actions:
        value = "" if action.nargs == 0 else str(action.metavar or action.dest)
        yield CommandArgument(tuple(action.option_strings), tuple(map(str, action.choices or ())), value, action.help or "")


def _bash_script(known: dict[str, list[CommandArgument]], shell: str) -> str:
    values, others = [], []
    for command, arguments in known.items():
        after: dict[str, list[str]] = {}  # What may follow an option: the options.
        for one in arguments:
            if one.value and one.names:
                after.setdefault(f'words="{_choices_text(one)}"' if _choices_text(one) else "return", []).extend(one.names)
        values += [f"{SCRIPT_INDENT}{_bash_pattern(command, names)}) {what} ;;" for what, names in after.items()]
        options = " ".join(name for one in arguments for name in one.names)
        others.append(f'{SCRIPT_INDENT}    "{command} -"*) words="{options}" ;;')
        for one in arguments:
            if not one.names:
                files = " files=1" if one.value == "FILE" else ""
                others.append(f'{SCRIPT_INDENT}    "{command} "*) words="{_choices_text(one)}"{files} ;;')
    return BASH_SCRIPT.format(
        shell=shell, before=SCRIPT_PREAMBLES[shell], cases=" ".join(model_files.case_files()), commands=" ".join(known),
        values="\n".join(values), others="\n".join(others),
    )  # fmt: skip


def _bash_pattern(command: str, names: list[str]) -> str:
    return "|".join(f'"{command} {name}"' for name in names)


def _choices_text(one: CommandArgument) -> str:
    """What there is to choose from; the shell's variable ``cases`` where cases are."""
    return "$cases" if one.value in ("FILE", "CASE") else " ".join(STEP_SOLVERS if one.value == "SOLVER" else one.choices)


def _fish_script(known: dict[str, list[CommandArgument]], about: dict[str, str]) -> str:
    lines = ["# Completes nsmodel; written by: nsmodel completion fish", f"set -l cases {' '.join(model_files.case_files())}"]
    for command, arguments in known.items():
        lines.append(f"complete -c nsmodel -n __fish_use_subcommand -f -a {command} -d {_fish_quoted(about.get(command, ''))}")
        for one in arguments:
            line = f"complete -c nsmodel -n '__fish_seen_subcommand_from {command}'"
            for name in one.names:
                line += f" -l {name[2:]}" if name.startswith("--") else f" -s {name[1:]}"
            if one.names and one.value:
                line += " -x" if _choices_text(one) else " -r"
            elif not one.names and one.value != "FILE":
                line += " -f"
            if _choices_text(one):
                line += f' -a "{_choices_text(one)}"'
            lines.append(f"{line} -d {_fish_quoted(one.help)}")
    return "\n".join(lines) + "\n"


def _fish_quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
