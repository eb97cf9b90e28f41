"""Programs that an operator writes: sequences of steps as data, checked, run by the task engine, exported to Python."""

from common.application import Application

APPLICATION = Application(
    topics="applications.programming.topics:TOPICS", task="program_runner", grasps=True,
    page="applications.programming.page:PAGE", verbs="applications.programming.verbs:VERBS")
