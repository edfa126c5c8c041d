"""What users write: the five model classes and the laws."""
