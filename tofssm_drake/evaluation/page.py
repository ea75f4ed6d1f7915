"""What the reports have in common: templates, look, pictures."""

import dataclasses as dc
import importlib.resources

import jinja2

from tofssm_drake.evaluation import figures


@dc.dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of a report in its two widths, as data URIs."""

    wide: str
    narrow: str
    description: str


def make_picture(make, description: str, *args, **options) -> Picture:
    """Draws a figure in both widths.

    Args:
        make: Function that returns the figure and takes `narrow`.
        description: For who can not see it.
        *args: For `make`.
        **options: For `make`.
    """
    return Picture(
        wide=figures.to_data_uri(make(*args, **options)),
        narrow=figures.to_data_uri(make(*args, narrow=True, **options)),
        description=description,
    )


def render_page(template: str, **values) -> str:
    """Returns a page as one HTML document that needs no other file.

    Args:
        template: File name of a template beside this module.
        **values: What it asks for; a missing one is an error.
    """
    folder = importlib.resources.files("tofssm_drake.evaluation")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(
            lambda name: folder.joinpath(name).read_text(encoding="utf-8")
        ),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(**values).lstrip()
