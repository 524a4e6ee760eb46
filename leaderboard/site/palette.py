"""Methods' colours on the site: the palette of all figures, as much darker or lighter as the page's ground asks for."""

from __future__ import annotations

from ..methods import PALETTE

LIGHT, DARK = "#ffffff", "#14171b"  # the grounds of site.css
CONTRAST = 3.0  # what WCAG 2.1 asks for of what is no text
_BRIGHT = "#e4e8ec"  # black in the dark


def colour_class(colour: str) -> str:
    """The class of what has a method's colour."""
    return f"m-{colour[1:].lower()}"


def palette_css() -> str:
    """Rules for :func:`colour_class`, by day, by night and on paper."""
    day = "".join(f"  --{colour_class(one)}: {on_ground(one, LIGHT)};\n" for one in PALETTE)
    night = "".join(f"  --{colour_class(one)}: {on_ground(one, DARK)};\n" for one in PALETTE)
    classes = "".join(f".{colour_class(one)} {{ color: var(--{colour_class(one)}); }}\n" for one in PALETTE)
    return (
        f"\n/* Colours of methods. */\n\n:root {{\n{day}}}\n\n"
        f'@media screen and (prefers-color-scheme: dark) {{\n:root:not([data-theme="light"]) {{\n{night}}}\n}}\n\n'
        f'@media screen {{\n:root[data-theme="dark"] {{\n{night}}}\n}}\n\n{classes}'
    )


def on_ground(colour: str, ground: str) -> str:
    """A colour of the same hue that stands out from a ground; black becomes almost white in the dark."""
    light = _luminance(ground) > 0.5
    if not light and max(_parts(colour)) < 8:
        return _BRIGHT
    towards = (0, 0, 0) if light else (255, 255, 255)
    for share in range(0, 101, 2):
        mixed = [round(part + (end - part) * share / 100) for part, end in zip(_parts(colour), towards, strict=True)]
        found = "#" + "".join(f"{part:02x}" for part in mixed)
        if contrast(found, ground) >= CONTRAST:
            return found
    raise AssertionError("white and black stand out from one another")


def contrast(first: str, second: str) -> float:
    """The contrast of two colours as WCAG 2.1 defines it."""
    low, high = sorted((_luminance(first), _luminance(second)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: str) -> float:
    red, green, blue = (part / 3294.6 if part <= 10 else ((part / 255 + 0.055) / 1.055) ** 2.4 for part in _parts(colour))
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _parts(colour: str) -> list[int]:
    return [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
