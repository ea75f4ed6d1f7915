"""The rows of the paper's experiment, asked by cell and metric."""

from tofssm_drake.paper.cells import ALONE, read_cell
import tofssm_drake.studies.results as studies


class Results(studies.Results):
    """Results of a campaign by `Cell`, metric and trial.

    Args:
        rows: What `make_results` returned, or rows read from
            results.parquet.
    """

    def __init__(self, rows: list[dict]):
        super().__init__(rows, read_cell)
        self.alone = self.references.get(ALONE)
        """The row of the run without a person; None: it is missing."""
