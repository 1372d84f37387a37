"""Campaigns for tests: settings or a folder in, the run out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from merge_sumo.campaigns import campaign
from merge_sumo.campaigns.recorded import RecordedCampaign, read_settings
from merge_sumo.campaigns.settings import CampaignSettings, controllers, settings_from_folder
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.scenario import US23


def campaign_settings(**settings: Any) -> CampaignSettings:
    """Return settings of a campaign, at level 0 of the paper's scenario unless they say others."""
    return CampaignSettings(**{"levels": (0,), "scenario": US23, **settings})


def run_campaign(
    settings: CampaignSettings,
    folder: Path,
    *,
    on_case: Callable[[Outcome], None] = lambda _: None,
    **other: Any,
) -> RecordedCampaign:
    def on_cases(outcomes: Sequence[Outcome]) -> None:
        for outcome in outcomes:
            on_case(outcome)

    callbacks = (on_cases, *other.pop("callbacks", ()))
    return campaign.run_campaign(settings, settings.load_plan(), folder, callbacks, **other)


def resume_campaign(
    folder: Path, given: Mapping[str, object] | None = None, **other: Any
) -> RecordedCampaign:
    """Go on with a campaign, with its controllers named again as they were."""
    recorded = read_settings(folder)
    named = {**controllers(recorded), **(given or {})}
    settings = settings_from_folder(folder, recorded, named, resumes=True)
    return campaign.run_campaign(settings, settings.load_plan(), folder, resumes=True, **other)
