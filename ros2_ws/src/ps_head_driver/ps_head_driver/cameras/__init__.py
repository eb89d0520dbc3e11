"""Camera back ends behind one small interface: fake, folder, topic."""
