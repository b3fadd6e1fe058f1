"""Camera streams: each made once by the robot and shown to every viewer."""
