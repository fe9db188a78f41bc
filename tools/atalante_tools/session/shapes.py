"""Guide shapes by name or file, as the user types them: `text -> GuideShape`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.names import find

if TYPE_CHECKING:
    from atalante_control.guide.shapes import GuideShape

#: Names of the guide shapes, a copy of the keys of `atalante_control.guide.shapes.SHAPES`.
#: The help text uses this copy, because the import of `atalante_control` is slow.
SHAPE_NAMES: Final = "constant, widening, narrowing, pinched, asymmetric, snap"
#: Description of a valid `--shape`, for help texts.
SHAPE_HELP: Final = f"{SHAPE_NAMES}; or a shape file (FILE.toml)"
_SUFFIX: Final = ".toml"


def guide_shapes(typed: Sequence[str]) -> dict[str, GuideShape]:
    """Return guide shapes by name, in the order of the texts that the user typed.

    A text that ends in `.toml` is the path of a shape file. Any other text is the name of a shape.

    Args:
        typed: Names or paths as the user typed them.

    Raises:
        ShapeError: If a shape file is invalid.
        click.UsageError: If a name is unknown, or two files contain shapes with the same name.
    """
    shapes: dict[str, GuideShape] = {}
    files: dict[str, Path] = {}  # name of a shape -> file that contains the shape
    for text in typed:
        shape = guide_shape(text)
        if text.endswith(_SUFFIX):
            path = Path(text).resolve()
            if files.setdefault(shape.name, path) != path:
                raise click.UsageError(
                    f"shapes from different files must have different names, got {shape.name!r} in "
                    f"{files[shape.name]} and {path}"
                )
        shapes[shape.name] = shape
    return shapes


def guide_shape(text: str) -> GuideShape:
    """Return the guide shape for a name or a path.

    Args:
        text: Name of a shape, or path of a shape file.

    Raises:
        ShapeError: If the shape file is invalid.
        click.UsageError: If the name is unknown.
    """
    from atalante_control.guide.shape_file import load_shape
    from atalante_control.guide.shapes import SHAPES

    if text.endswith(_SUFFIX):
        return load_shape(Path(text))
    names = tuple(SHAPES)
    return SHAPES[names[find(text, names, f"guide shape (or a file that ends in {_SUFFIX})")]]
