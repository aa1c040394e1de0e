"""Parts of the estimator: wheels, floors under the wheels, effects of floors, pose and fixes."""
