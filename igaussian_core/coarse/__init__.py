"""Stage one: where roughly is the camera?"""
