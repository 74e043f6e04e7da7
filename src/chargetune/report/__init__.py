"""Figures and pages of a study, from its store alone. matplotlib is imported when the first figure is made."""

from chargetune.report.figures.seeds import seeds_figure
from chargetune.report.figures.study_figures import figure_names, figures_of, save_figures
from chargetune.report.page.page import report_page
from chargetune.report.study_view import StudyView, read_study

__all__ = ["StudyView", "figure_names", "figures_of", "read_study", "report_page", "save_figures", "seeds_figure"]
