"""CAN FD frames and their contents: process image, signal codec, E2E protection, CiA 402 drive states."""
