"""Command ``l2p completion``: a script that completes the words of ``l2p`` in bash or zsh.

It is made from the parser itself, so that every command and flag is in it.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator

from l2p.attacks.settings import METHODS
from l2p.maps import ATTRIBUTES

SHELLS = ("bash", "zsh")
#: Words for flags that take other words, too.
_WORDS = {"--method": METHODS, "--ignore": ATTRIBUTES, "--device": ("cpu", "cuda")}

_BASH = """\
# Completes the words of l2p in bash; made by: l2p completion bash
_l2p() {{
    local cur=${{COMP_WORDS[COMP_CWORD]}} prev=${{COMP_WORDS[COMP_CWORD-1]}} flag="" words="" i
    COMPREPLY=()
    if ((COMP_CWORD == 1)); then
        COMPREPLY=($(compgen -W {commands} -- "$cur"))
        return
    fi
    # The last flag: some take several words.
    for ((i = 2; i < COMP_CWORD; i++)); do
        [[ ${{COMP_WORDS[i]}} == -* ]] && flag=${{COMP_WORDS[i]}}
    done
    if [[ $cur == -* ]]; then
        case ${{COMP_WORDS[1]}} in
{flags}
        esac
    else
        case "${{COMP_WORDS[1]}} $prev" in
{single}
        esac
        case "${{COMP_WORDS[1]}} $flag" in
{several}
        esac
    fi
    [[ $words ]] && COMPREPLY=($(compgen -W "$words" -- "$cur"))
}}
# Where no word is known, names of files.
complete -o default -F _l2p l2p
"""

_ZSH = """\
#compdef l2p
# Completes the words of l2p in zsh; made by: l2p completion zsh
_l2p() {{
    local -a commands
    commands=(
{commands}
    )
    if ((CURRENT == 2)); then
        _describe command commands
        return
    fi
    shift words
    ((CURRENT--))
    case $words[1] in
{cases}
    esac
}}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    _l2p "$@"
else
    compdef _l2p l2p
fi
"""


def completion_script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Make the script of a shell from the parser of a program with commands."""
    return _bash(parser) if shell == "bash" else _zsh(parser)


def _bash(parser: argparse.ArgumentParser) -> str:
    flags, single, several = [], [], []
    for name, _, command in _commands(parser):
        options = [action for action in command._actions if action.option_strings]
        flags.append(f"            {name}) words={_quoted(word for a in options for word in a.option_strings)} ;;")
        for action in command._actions:
            if not (words := _words_of(action)):
                continue
            cases = "|".join(f'"{name} {flag}"' for flag in action.option_strings) or f'"{name} {name}"'
            (several if action.nargs == "+" else single).append(f"            {cases}) words={_quoted(words)} ;;")
    own = [name for name, _, _ in _commands(parser)]
    own += [word for action in parser._actions for word in action.option_strings]
    return _BASH.format(
        commands=_quoted(own), flags="\n".join(flags), single="\n".join(single), several="\n".join(several)
    )


def _zsh(parser: argparse.ArgumentParser) -> str:
    commands = "\n".join(f"        {shlex.quote(f'{name}:{what}')}" for name, what, _ in _commands(parser))
    cases = []
    for name, _, command in _commands(parser):
        specs = " \\\n".join(f"                {shlex.quote(spec)}" for a in command._actions for spec in _specs(a))
        cases.append(f"        {name})\n            _arguments \\\n{specs}\n            ;;")
    return _ZSH.format(commands=commands, cases="\n".join(cases))


def _specs(action: argparse.Action) -> Iterator[str]:
    """Words of one argument for zsh's _arguments."""
    words = _words_of(action)
    names = action.metavar or action.dest
    offers = f"({' '.join(words)})" if words else "_files" if action.type is None else " "
    message = _escaped(names[0] if isinstance(names, tuple) else names)
    if not action.option_strings:
        yield f"{'*' if action.nargs == '+' else ''}:{message}:{offers}"
        return
    if action.nargs == 0:
        takes = ""
    elif action.nargs == "+":
        takes = f":*-*:{message}:{offers}"
    elif isinstance(action.nargs, int):
        takes = "".join(f":{_escaped(name)}: " for name in (names if isinstance(names, tuple) else (message,)))
    else:
        takes = f":{':' if action.nargs == '?' else ''}{message}:{offers}"
    repeated = "*" if isinstance(action, argparse._AppendAction) else ""
    for flag in action.option_strings:
        yield f"{repeated}{flag}[{_escaped(_help(action))}]{takes}"


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Name, help and parser of each command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for told in action._choices_actions:
                yield told.dest, str(told.help), action.choices[told.dest]


def _words_of(action: argparse.Action) -> tuple[str, ...]:
    if action.choices is not None:
        return tuple(map(str, action.choices))
    return next((_WORDS[flag] for flag in action.option_strings if flag in _WORDS), ())


def _help(action: argparse.Action) -> str:
    """The first words of a help."""
    text = "show the help" if isinstance(action, argparse._HelpAction) else (action.help or "").replace("%%", "%")
    return text.split("; ")[0].split(" (default")[0]


def _escaped(text: str) -> str:
    for sign in ("\\", "[", "]", ":"):
        text = text.replace(sign, f"\\{sign}")
    return text


def _quoted(words: Iterator[str] | tuple[str, ...] | list[str]) -> str:
    return shlex.quote(" ".join(words))
