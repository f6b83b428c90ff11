"""Parts of the quality builder: the curve, the binary tree of pairs, and what is left of it after pruning."""
