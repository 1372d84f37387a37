"""What the package brings keeps its contracts; that of samplers is run in their room."""

from __future__ import annotations

import pytest
from conftest import some

from merge_sumo.reports.formats import FORMATS
from merge_sumo.reports.report_sections import SECTIONS
from merge_sumo.testing import CriterionContract, ExportContract, ReportSectionContract, VutContract
from merge_sumo.values.criteria import CRITERIA

VUTS = ("level0", "level2", "design2", "careful", "sumo:IDM")


class TestEveryCriterion(CriterionContract):
    @pytest.fixture(autouse=True, params=list(CRITERIA))
    def _subject(self, request):
        self.criterion = CRITERIA[request.param]


class TestEveryFormat(ExportContract):
    @pytest.fixture(autouse=True, params=list(FORMATS))
    def _subject(self, request):
        self.export_format = FORMATS[request.param]


class TestEverySection(ReportSectionContract):
    @pytest.fixture(autouse=True, params=list(SECTIONS))
    def _subject(self, request):
        self.section = SECTIONS[request.param]


class TestVuts(VutContract):
    @pytest.fixture(autouse=True, params=some(VUTS, "design2", "sumo:IDM"))
    def _subject(self, request):
        self.vut = request.param
