"""PMU Network Characterizer: streams through meters to figures, verdicts and a report."""
