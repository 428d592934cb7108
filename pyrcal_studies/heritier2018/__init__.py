"""Heritier et al. 2018 (MNRAS 481, 2829) played on the simulated telescope, figure by figure.

One HTML report puts every figure and table beside the paper's own values. All numbers in it come
from the run; steps are kept on disk, so an interrupted run goes on where it was.
Run: ``make paper``, or ``python -m pyrcal_studies.heritier2018 --quick`` for a rehearsal.
"""
