"""SLAMCU on the vehicle (Jo, Kim and Sunwoo 2018): existence of features, and a Rao-Blackwellised particle filter."""
