"""Policy: a learned policy moves the arm; each chunk of its actions is proved safe before the arm moves."""

from common.application import Application

APPLICATION = Application(
    topics="applications.policy.topics:TOPICS", task="policy_runner", grasps=True,
    figures="applications.policy.figures:PolicyFigures", page="applications.policy.page:PAGE")
