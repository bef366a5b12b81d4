"""The leaderboard: finished runs checked and added to CSVs, and a page made from the CSVs alone."""
