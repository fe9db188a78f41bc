"""The virtual guide: shapes, filter, kernel, backup policy and certificate."""
