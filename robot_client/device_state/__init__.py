"""The device manager: measures battery, CPU, memory, disk, temperature and signal, and reports what is critical."""
