"""The experiment of the SLAMCU paper (Jo, Kim and Sunwoo 2018, section 6) on simulated motorways."""
