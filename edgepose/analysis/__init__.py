"""Analysis of poses: metrics, joint angles, figures and reports."""
