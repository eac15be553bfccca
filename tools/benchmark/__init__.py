"""The laboratory: training and labelling speed, the tables of the paper, surfaces, a city. Not part of the
installed package.
"""
