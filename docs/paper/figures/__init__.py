"""The figures of "Panoramas from Photons", from simulated captures: a module for each, with its numbers and its claims."""

from __future__ import annotations

from paper.figures import cameras, costs, levels, light, matches, others, teaser
from paper.figures.study import FigureOf

FIGURES = {
    "fig1": FigureOf(teaser.make, teaser.claims),
    "fig2": FigureOf(matches.make, matches.claims),
    "fig3": FigureOf(levels.loop, levels.loop_claims),
    "fig4": FigureOf(cameras.make, cameras.claims),
    "fig4-light": FigureOf(cameras.darker, cameras.darker_claims),
    "fig5": FigureOf(levels.without_new_groups, levels.groups_claims),
    "fig6": FigureOf(levels.refinement, levels.refinement_claims),
    "fig7": FigureOf(light.super_resolution, light.super_resolution_claims),
    "fig8": FigureOf(light.dynamic_range, light.range_claims),
    "fig9": FigureOf(others.high_speed, others.high_speed_claims),
    "fig10": FigureOf(light.flicker, light.flicker_claims),
    "fig11": FigureOf(others.poses, others.poses_claims),
    "s1": FigureOf(others.bursts, others.bursts_claims),
    "s2": FigureOf(levels.ends, levels.ends_claims),
    "group-size": FigureOf(costs.group_sizes, costs.sizes_claims),
    "run-time": FigureOf(costs.run_time, costs.run_time_claims),
}
"""Figures of the paper by name, in its order."""
