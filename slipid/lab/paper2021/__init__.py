"""Reproduction of Belyaev, Brylev, Ivanov 2021: tables, figures, stored models and the method.

Source: "Slip Detection and Compensation System for Mobile Robot in Heterogeneous Environment",
IFAC-PapersOnLine 54(13), 2021; data of its authors' repository BrOleg5/Slippage-compensation.
"""
