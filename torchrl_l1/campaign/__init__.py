"""Campaigns: matrices of runs and evaluations, worked off by local workers or Hydra launchers."""

from torchrl_l1.campaign.description import read_campaign
from torchrl_l1.campaign.settings import Campaign, CampaignError, EvaluationSettings, RunMatrix

__all__ = ["Campaign", "CampaignError", "EvaluationSettings", "RunMatrix", "read_campaign"]
