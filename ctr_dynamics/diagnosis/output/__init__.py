"""From a verdict to files: findings.json, the report, robot files, and the summary as text."""
