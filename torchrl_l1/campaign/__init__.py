"""Campaigns: matrices of runs and evaluations, executed by local workers or Hydra launchers."""

from torchrl_l1.campaign.description import (
    Campaign,
    CampaignError,
    EvaluationSettings,
    RunMatrix,
    read_campaign,
)

__all__ = ["Campaign", "CampaignError", "EvaluationSettings", "RunMatrix", "read_campaign"]
