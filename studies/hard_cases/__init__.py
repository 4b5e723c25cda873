"""Cases that make localisation fail, with known truth: does the vehicle say when it is wrong?"""
