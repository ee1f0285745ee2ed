"""Where the lidars are: poses compared with what the lidars see of the same surfaces."""
