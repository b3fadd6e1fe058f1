"""Applications: programs over the public interface of a relay. They run anywhere, and use nothing of the daemon."""
