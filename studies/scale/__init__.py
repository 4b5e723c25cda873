"""How the cloud scales: a model of its queues, measured costs, and what cities, countries and the world would take."""
