"""What stages leave for each other on the disk, and how it is named: ids, manifests, records, references."""
