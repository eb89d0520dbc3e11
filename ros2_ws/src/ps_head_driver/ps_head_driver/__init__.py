"""The head: kinematics, convergence radius, light model, link, cameras, fake hardware."""
