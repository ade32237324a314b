"""Poses of a whole recording at once: Sparse Inertial Poser (SIP) and its start, the orientation poser (SOP).

After von Marcard, Rosenhahn, Black, Pons-Moll, Sparse Inertial Poser, 2017; equations, tables and sections in
this package have the numbers of that paper. Runs on numpy and scipy; no network, no training.
"""
