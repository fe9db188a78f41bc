"""CAN FD frames and what is in them: process image, signal codec, E2E protection, CiA 402 drive states."""
