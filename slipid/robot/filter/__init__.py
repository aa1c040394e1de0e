"""Parts of the estimator: wheels, floors under them, what fits miss, the pose and its fixes."""
