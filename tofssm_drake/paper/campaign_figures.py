"""The figures of a campaign: the paper's 9 to 12, and that of the audit."""

from tofssm_drake.paper.audit_figure import make_audit_figure
from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.distance_figure import make_distance_figure
from tofssm_drake.paper.productivity_figure import make_productivity_figure
from tofssm_drake.paper.radar_figure import make_radar_figure
from tofssm_drake.paper.response_figures import (
    make_phase_figure,
    make_response_figure,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.samples import Samples


def list_figures(
    results: Results, samples: dict[Cell, Samples]
) -> dict[str, tuple]:
    """Returns how to draw each figure: (function, description, arguments).

    Args:
        results: Of the campaign.
        samples: One run of each cell without a variant.
    """
    nine = {
        cell: run for cell, run in samples.items() if cell.sensing != "tof16"
    }
    over_time = {
        cell: run for cell, run in nine.items() if cell.configuration == "vo"
    }
    return {
        "fig09_distance": (
            make_distance_figure,
            "Measured against true distance over time for each sensing, and "
            "bars of their errors.",
            (results, over_time or nine),
        ),
        "fig10_productivity_safety": (
            make_productivity_figure,
            "Productivity against safety metric: mean and confidence ellipse "
            "of each cell, and every run as a faint point.",
            (results,),
        ),
        "fig11_response": (
            make_response_figure,
            "Tool speed and measured distance over time, a panel per cell.",
            (nine,),
        ),
        "fig11_phase": (
            make_phase_figure,
            "How often which tool speed at which measured distance, a panel "
            "per cell.",
            (nine,),
        ),
        "audit_shortfall": (
            make_audit_figure,
            "For each cell by how much its critical distance is shorter than "
            "the protective separation distance of ISO/TS 15066.",
            (results,),
        ),
        "fig12_radars": (
            make_radar_figure,
            "Four radars: reaction time, times to stop and to reduce, tool "
            "speed at a stop, separation at events. The numbers are in the "
            "table beside it.",
            (results,),
        ),
    }
