"""Handover: one arm picks what the camera sees and hands it to the other arm, which puts it into its box."""

from common.application import Application

APPLICATION = Application(topics="applications.hand_over.topics:TOPICS", task="hander", grasps=True)
