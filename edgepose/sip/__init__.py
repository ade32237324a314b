"""Poses of a whole recording by optimisation: Sparse Inertial Poser (SIP), Sparse Orientation Poser (SOP).

After von Marcard, Rosenhahn, Black, Pons-Moll, Sparse Inertial Poser, 2017; the numbers of equations, tables
and sections in this package are those of that paper. Runs on numpy and scipy; no network, no training.
"""
