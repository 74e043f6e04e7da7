"""Figures and pages of a study, from its store alone. matplotlib is imported when the first figure is made."""

from chargetune.report.figures import figures_of, save_figures
from chargetune.report.page import report_page
from chargetune.report.reading import StudyView, read_study
from chargetune.report.seeds import seeds_figure

__all__ = ["StudyView", "figures_of", "read_study", "report_page", "save_figures", "seeds_figure"]
