"""A new feature layer from one drive (Kim, Cho, Sunwoo and Jo 2018): a graph of motion, GNSS, features and lanes."""
