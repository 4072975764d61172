"""What a person asks of effects: `auto`, `all`, `none` or `as-set`, and names with + and −."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

from neilfpp_method.effects.catalogue import EFFECTS
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["BASES", "Asked", "check_asked", "read_asked"]

BASES = ("auto", "all", "none", "as-set")
"""Who decides an effect that is not named: evidence; nobody (all on or all off); the settings."""
ELSEWHERE = {
    "response": "what pixels are of radiance is told from the files; say it with --response linear or srgb",
}
"""What the table shows and other options decide."""


@dataclass(frozen=True)
class Asked:
    """`base` is one of `BASES`; `named` says on or off for the effects that are named."""

    base: str = "auto"
    named: Mapping[str, bool] = field(default_factory=dict)

    def __str__(self) -> str:
        return ",".join((self.base, *(f"{'+' if on else '-'}{name}" for name, on in self.named.items())))


def read_asked(text: str) -> Asked:
    """The value of `--effects`.

    Raises:
        UserError: a name that no effect has, or one that is named twice.

    Example:
        >>> read_asked("auto,-lamps")
        Asked(base='auto', named={'lamps': False})
        >>> str(read_asked("+lamps"))
        'auto,+lamps'
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    base = words.pop(0) if words and words[0] in BASES else "auto"
    named: dict[str, bool] = {}
    for word in words:
        sign, name = word[0], word[1:]
        if sign not in "+-" and word in EFFECTS:
            raise UserError(f"--effects: '{word}' has no sign", f"write +{word} or -{word}")
        if sign not in "+-":
            raise _unknown(word, f"'{word}' is no choice")
        if name in ELSEWHERE:
            raise UserError(f"--effects: {name} is not switched here", ELSEWHERE[name])
        if name not in EFFECTS:
            raise _unknown(name, f"no effect '{name}'")
        if name in named:
            raise UserError(f"--effects: {name} is named twice", "name it once")
        named[name] = sign == "+"
    if not text.strip():
        raise _unknown("", "nothing is given")
    return Asked(base, named)


def check_asked(asked: Asked, config: NeilfConfig) -> None:
    """That every effect that is named can be switched with these settings.

    Raises:
        UserError: one cannot.
    """
    for name, on in asked.named.items():
        obstacle = EFFECTS[name].obstacle(config)
        if obstacle:
            raise UserError(
                f"--effects {'+' if on else '-'}{name}: {obstacle}",
                f"leave {name} out, or change the settings",
            )
        needs = EFFECTS[name].needs
        if on and needs and not asked.named.get(needs, asked.base != "none"):
            raise UserError(
                f"--effects +{name}: there is none without {needs}", f"add +{needs}, or leave {name} out"
            )


def _unknown(word: str, what: str) -> UserError:
    near = get_close_matches(word, EFFECTS, n=1)
    remedy = (
        f"did you mean '{near[0]}'?"
        if near
        else f"give {', '.join(BASES)}, or a list of {', '.join(EFFECTS)} with + or -"
    )
    return UserError(f"--effects: {what}", remedy)
