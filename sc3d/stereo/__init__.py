"""Dense depth from photos and cameras: PatchMatch stereo with slanted planes, checked between the views."""
