"""The same on a GPU: gsplat renders, and torch operations compute the losses; twins of the kernels in `cpu`."""
