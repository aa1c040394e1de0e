"""Parts of the estimator: wheels, floors under them, effects of floors, the pose and its fixes."""
