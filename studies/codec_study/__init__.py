"""What tiles weigh and what rounding does to poses, on real recordings and simulated places; how tables were learnt."""
