"""The same on a GPU: gsplat renders, torch operations compute the losses; twins of the kernels in `cpu`."""
