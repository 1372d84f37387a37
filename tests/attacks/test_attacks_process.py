"""One process that goes on for long, and threads."""

from __future__ import annotations

import threading

from campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.run import OUTCOMES

SETTINGS = {
    name: campaign_settings(vut="design1", sampler=name, cases=40, batch=20, seed=4)
    for name in ("uniform", "gpr")
}


class TestThreads:
    def test_at_the_same_time_do_not_disturb_each_other(self, tmp_path):
        wrong: list[BaseException] = []

        def work(name: str, number: int) -> None:
            try:
                run_campaign(SETTINGS[name], tmp_path / f"{name}-{number}")
            except BaseException as error:
                wrong.append(error)

        threads = [
            threading.Thread(target=work, args=(name, number))
            for name in SETTINGS
            for number in range(2)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []
        for name, settings in SETTINGS.items():
            run_campaign(settings, tmp_path / f"{name}-alone")
            written = {path.joinpath(OUTCOMES).read_bytes() for path in tmp_path.glob(f"{name}-*")}
            assert len(written) == 1
