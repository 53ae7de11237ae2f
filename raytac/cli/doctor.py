"""``raytac doctor``."""

from __future__ import annotations

from dataclasses import dataclass

from raytac.doctor import diagnose


@dataclass(frozen=True, kw_only=True)
class DoctorArgs:
    """Try everything that the jobs need, say what will be used and how to fix what is missing.

    Exit code 1 only if the default job (rigid pad, ray tracer) cannot run.
    """

    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        report = diagnose()
        print(report.to_json() if self.json else report.to_text())
        return report.exit_code
