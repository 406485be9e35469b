"""Stage two: where exactly is the camera, and can that be believed?"""
