"""The figures of "Panoramas from Photons", from simulated captures: a module for each, with its numbers and its claims."""

from __future__ import annotations

from paper.figures import cameras, costs, levels, light, matches, others, teaser

FIGURES = {
    "fig1": teaser.FIGURE,
    "fig2": matches.FIGURE,
    "fig3": levels.FIG3,
    "fig4": cameras.FIGURE,
    "fig4-light": cameras.LIGHT,
    "fig5": levels.FIG5,
    "fig6": levels.FIG6,
    "fig7": light.FIG7,
    "fig8": light.FIG8,
    "fig9": others.HIGH_SPEED,
    "fig10": light.FIG10,
    "fig11": others.POSES,
    "s1": others.BURSTS,
    "s2": levels.S2,
    "group-size": costs.SIZES_FIGURE,
    "run-time": costs.RUN_TIME,
}
"""Figures of the paper by name, in its order."""
