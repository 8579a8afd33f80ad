"""Draw the committed factorial of drawings: each animal of a list in each of seven emoji styles.

    python data/emoji_styles/make.py PACKS [--size 112]

PACKS holds the unpacked Iconify icon sets ``@iconify-json/<style>``, a folder ``<style>`` for each, with icons.json,
info.json and package.json. The result is ``<style>/<species>.png`` beside this script, transparent around the drawing,
and LICENCES.md, put together from what the packs say of themselves and from notices.toml. Needs the package resvg-py
(0.5); the pictures that are committed need nothing.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError, nearest

HERE = Path(__file__).resolve().parent

STYLES = (
    "emojione",
    "fluent-emoji",
    "fluent-emoji-flat",
    "fluent-emoji-high-contrast",
    "noto",
    "openmoji",
    "twemoji",
)

# Chosen by looking at all animals that the seven packs have in common. Left out:
# the second picture of an animal: all *-face, hatching-chick, spouting-whale, and ewe, which twemoji draws as a ram;
# head in some styles, body in others: baby-chick, boar, camel, chicken, deer, eagle, gorilla, koala, rhinoceros, shark;
# another thing of the same name: cricket, which in emojione is the game.
# Of bear, fox, frog, hamster, lion, panda, unicorn and wolf every style draws the head.
# fmt: off
SPECIES = (
    "ant", "bat", "bear", "bird", "blowfish", "bug", "butterfly", "cat", "chipmunk", "cow", "crab", "crocodile",
    "dog", "dolphin", "dove", "dragon", "duck", "elephant", "fish", "fox", "frog", "front-facing-baby-chick",
    "goat", "hamster", "honeybee", "horse", "lady-beetle", "leopard", "lion", "lizard", "monkey", "mouse",
    "octopus", "owl", "ox", "panda", "penguin", "pig", "poodle", "rabbit", "ram", "rat", "rooster", "scorpion",
    "shrimp", "snail", "snake", "spider", "squid", "tiger", "tropical-fish", "turkey", "turtle",
    "two-hump-camel", "unicorn", "water-buffalo", "whale", "wolf",
)
# fmt: on

# The renderer leaves the edges of filtered shapes jagged, and fluent-emoji filters nearly everything.
_OVERSAMPLING = 4


@dataclass(frozen=True)
class Pack:
    """One style as its icon set describes it.

    Attributes:
        style: name of its folder.
        icons: content of icons.json.
        info: content of info.json: author and licence.
        package: content of package.json: name and version.
    """

    style: str
    icons: dict[str, Any]
    info: dict[str, Any]
    package: dict[str, Any]

    def original(self, species: str) -> str:
        """Return the name under which the pack holds the drawing, behind any aliases.

        Raises:
            UserError: the pack has no such drawing, or only a turned or mirrored one.
        """
        aliases, name = self.icons.get("aliases", {}), species
        while name not in self.icons["icons"]:
            if name not in aliases:
                names = {*self.icons["icons"], *aliases}
                raise UserError(f"{self.style}/icons.json: no icon '{name}', {nearest(name, names)}")
            if aliases[name].keys() - {"parent"}:
                raise UserError(f"{self.style}/icons.json: alias '{name}' changes its icon, expected a parent only")
            name = aliases[name]["parent"]
        return name

    def svg(self, species: str) -> str:
        """Return a drawing as a square SVG document, in the middle, black where the pack leaves the colour open.

        Raises:
            UserError: the pack has no such drawing.
        """
        icon = {"left": 0, "top": 0, "width": 16, "height": 16, **self.icons}
        icon |= self.icons["icons"][self.original(species)]
        side = max(icon["width"], icon["height"])
        left = icon["left"] - (side - icon["width"]) / 2
        top = icon["top"] - (side - icon["height"]) / 2
        spaces = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
        body = icon["body"].replace("currentColor", "#000")
        return f'<svg {spaces} viewBox="{left:g} {top:g} {side:g} {side:g}">{body}</svg>'


def read_pack(packs: Path, style: str) -> Pack:
    """Read one icon set.

    Raises:
        UserError: a folder or file is missing or no JSON.
    """
    folder = packs / style
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; expected one for each of {', '.join(STYLES)}")
    contents = []
    for name in ("icons.json", "info.json", "package.json"):
        try:
            contents.append(json.loads((folder / name).read_text(encoding="utf-8")))
        except OSError as error:
            raise UserError(f"{folder / name}: cannot be read ({error.strerror or error})") from error
        except ValueError as error:
            raise UserError(f"{folder / name}: is no JSON ({error})") from error
    return Pack(style, *contents)


def draw(svg: str, size: int) -> bytes:
    """Return an SVG document as a PNG of ``size`` x ``size``, transparent around what it shows.

    Raises:
        UserError: resvg-py is not installed.
    """
    try:
        from resvg_py import svg_to_bytes
    except ImportError as error:
        raise UserError("resvg-py is not installed, and the drawings cannot be made without it") from error
    fine = size * _OVERSAMPLING
    drawing = Image.open(io.BytesIO(bytes(svg_to_bytes(svg_string=svg, width=fine, height=fine)))).convert("RGBA")
    content = io.BytesIO()
    # Colours weighed by their opacity, or what is transparent would darken the edges.
    drawing.convert("RGBa").reduce(_OVERSAMPLING).convert("RGBA").save(content, "PNG", optimize=True)
    return content.getvalue()


def licences(packs: Sequence[Pack], size: int) -> str:
    """Return LICENCES.md: for each style its origin, author, licence, notice and what was changed.

    Raises:
        UserError: a pack came under another licence than the one whose notice is at hand.
    """
    notices = tomllib.loads((HERE / "notices.toml").read_text(encoding="utf-8"))
    lines = [notices["introduction"]]
    for pack in packs:
        author, licence, notice = pack.info["author"], pack.info["license"], notices["styles"][pack.style]
        if licence["spdx"] != notice["licence"]:
            raise UserError(
                f"{pack.style}/info.json: licence {licence['spdx']}, notices.toml has the notice of {notice['licence']}"
            )
        held_as = [f"{name} is its `{pack.original(name)}`" for name in SPECIES if pack.original(name) != name]
        changes = f"rendered to PNG, {size} x {size} px" + "".join(f"; {line}" for line in held_as)
        lines += [
            f"## {pack.style}\n",
            "| | |\n|---|---|",
            f"| pictures | `{pack.style}/*.png` |",
            f"| made from | {pack.info['name']}, icon set `{pack.package['name']}` {pack.package['version']} |",
            f"| author | {author['name']}, {author['url']} |",
            f"| licence | {licence['title']}, {licence['url']} |",
            f"| changes made | {changes} |\n",
            notice["text"],
        ]
    used = {pack.info["license"]["spdx"] for pack in packs}
    lines += [notices["licences"][spdx] for spdx in sorted(used)]
    return "\n".join(lines).rstrip() + "\n"


def make(packs: Path, size: int, output: Path = HERE) -> int:
    """Draw everything, then write it; pictures of species that are no longer listed vanish. Returns the bytes.

    Raises:
        UserError: a pack or drawing is missing, resvg-py is not installed, or the output cannot be written.
    """
    if not 16 <= size <= 512:
        raise UserError(f"size must be from 16 to 512, got {size}")
    read = [read_pack(packs, style) for style in STYLES]
    pictures = {output / pack.style / f"{name}.png": draw(pack.svg(name), size) for pack in read for name in SPECIES}
    text = licences(read, size)
    for file, content in {**pictures, output / "LICENCES.md": text.encode()}.items():
        with whole_file(file) as temporary:
            temporary.write_bytes(content)
    for stale in {file for style in STYLES for file in (output / style).glob("*.png")} - pictures.keys():
        stale.unlink()
    return sum(map(len, pictures.values()))


def main() -> int:
    """Run the command line; returns the exit code, 2 for what the user can mend."""
    parser = argparse.ArgumentParser(description="Draw emoji animals in several styles.")
    parser.add_argument("packs", type=Path, help="folder of the unpacked icon sets")
    parser.add_argument("--size", type=int, default=112, help="height and width in pixels (default 112)")
    options = parser.parse_args()
    try:
        written = make(options.packs, options.size)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{len(STYLES)} styles x {len(SPECIES)} species, {written:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
