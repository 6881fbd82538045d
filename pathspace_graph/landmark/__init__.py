"""The landmark estimators with Hungarian association, which the curves are compared with."""
