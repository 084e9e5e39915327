"""Reports as single HTML files that open offline: a page, figures, a backbone animation, and the report of a replay."""

from ctr_dynamics.reporting.figures import Panel, figure_svg
from ctr_dynamics.reporting.page import Markup, Page

__all__ = ["Markup", "Page", "Panel", "figure_svg"]
