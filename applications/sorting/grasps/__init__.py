"""Grasps: geometric candidates on a surface seen from above, their score, and the proof that the arm reaches them."""
