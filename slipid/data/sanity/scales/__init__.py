"""Which units and sizes explain how far each channel says the robot went?"""
