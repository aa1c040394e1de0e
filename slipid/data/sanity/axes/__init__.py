"""Which order, signs and axes explain the motion?"""
