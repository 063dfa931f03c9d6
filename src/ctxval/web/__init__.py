"""The operator's page: a campaign that people execute by hand, in a browser. It needs the extra ``web``."""
