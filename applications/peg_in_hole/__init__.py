"""Insertion: pick a peg where the camera sees it, and insert it by the force at the tool."""

from common.application import Application

APPLICATION = Application(
    topics="applications.peg_in_hole.topics:TOPICS", task="inserter", grasps=True,
    figures="applications.peg_in_hole.figures:InsertionFigures")
