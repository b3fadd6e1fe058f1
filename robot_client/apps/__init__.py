"""Applications: programs over the public interface of a relay. They run anywhere, and need no daemon beside them."""
