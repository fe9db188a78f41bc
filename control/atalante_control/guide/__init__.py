"""Virtual guide: shapes, filter, compiled kernel, backup policy and certificate."""
