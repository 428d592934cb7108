"""Heritier et al. 2018 (MNRAS 481, 2829) on the simulated telescope, figure by figure.

``make paper`` writes docs/results/heritier2018.md and its pictures: every equation, table, figure
and claim of the paper beside ours. All numbers come from the run. Each step is kept on disk, so an
interrupted run continues where it was.
"""
