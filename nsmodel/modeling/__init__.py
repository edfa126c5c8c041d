"""What users write: the six model classes and the laws."""
