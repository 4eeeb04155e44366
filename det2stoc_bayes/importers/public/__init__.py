"""Public recordings of real systems that `det2stoc fetch` brings; each module describes and converts one data set."""

NAMES = ("ball_drops", "cube_contactnets", "pendulum_multiarm", "servo_xl330")
