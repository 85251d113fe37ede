"""Who may do what: certificates of the machines, users and tokens of the page, and the log of what they did."""
