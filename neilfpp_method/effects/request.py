"""Parse the option `--effects`: `auto`, `all`, `none` or `as-set`, and names of effects with + or −."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

from neilfpp_method.effects.catalogue import EFFECTS
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["BASES", "EffectRequest", "check_effects", "parse_effects"]

BASES = ("auto", "all", "none", "as-set")
"""How effects that are not named are decided: by evidence, all on, all off, or by the settings."""
NOT_BY_EFFECTS = {
    "response": "it is read from the image files; override it with --response linear or srgb",
}
"""Effects of the table that another option sets, with the remedy of the error message."""


@dataclass(frozen=True)
class EffectRequest:
    """The value of `--effects`.

    Attributes:
        base: one of `BASES`.
        named: whether each effect that is named is to be on.
    """

    base: str = "auto"
    named: Mapping[str, bool] = field(default_factory=dict)

    def __str__(self) -> str:
        return ",".join((self.base, *(f"{'+' if on else '-'}{name}" for name, on in self.named.items())))


def parse_effects(text: str) -> EffectRequest:
    """Parse the value of `--effects`.

    Raises:
        UserError: if a name is unknown, has no sign, or occurs twice.

    Example:
        >>> parse_effects("auto,-lamps")
        EffectRequest(base='auto', named={'lamps': False})
        >>> str(parse_effects("+lamps"))
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
            raise _unknown(word, f"'{word}' is not a choice")
        if name in NOT_BY_EFFECTS:
            raise UserError(f"--effects: {name} cannot be set here", NOT_BY_EFFECTS[name])
        if name not in EFFECTS:
            raise _unknown(name, f"no effect '{name}'")
        if name in named:
            raise UserError(f"--effects: {name} is named twice", "name it once")
        named[name] = sign == "+"
    if not text.strip():
        raise _unknown("", "the value is empty")
    return EffectRequest(base, named)


def check_effects(request: EffectRequest, config: NeilfConfig) -> None:
    """Check that every named effect can be switched with these settings.

    Raises:
        UserError: if one cannot, or if it needs another effect that is off.
    """
    for name, on in request.named.items():
        obstacle = EFFECTS[name].obstacle(config)
        if obstacle:
            raise UserError(
                f"--effects {'+' if on else '-'}{name}: {obstacle}",
                f"leave {name} out, or change the settings",
            )
        needs = EFFECTS[name].needs
        if on and needs and not request.named.get(needs, request.base != "none"):
            raise UserError(
                f"--effects +{name}: {name} requires {needs}", f"add +{needs}, or leave {name} out"
            )


def _unknown(word: str, what: str) -> UserError:
    """The error for a word that is not a name, with the most similar name as the remedy."""
    near = get_close_matches(word, EFFECTS, n=1)
    remedy = (
        f"did you mean '{near[0]}'?"
        if near
        else f"give {', '.join(BASES)}, or a list of {', '.join(EFFECTS)} with + or -"
    )
    return UserError(f"--effects: {what}", remedy)
